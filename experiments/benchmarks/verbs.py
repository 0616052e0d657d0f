"""The public verbs on the examples of the README and of their documentation: what the benchmarks of waiting times call."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

import dyntorch as dyn

Verb = Callable[[], object]


def draw(seed: int = 0) -> torch.Generator:
    """A generator of random numbers."""
    return torch.Generator().manual_seed(seed)


def planar() -> Verb:
    """The road of the README."""
    from dyntorch import scenes

    views = scenes.planar(n=120, sigma=0.5, static=0.4, outliers=0.15, generator=draw(4)).views
    return lambda: dyn.align_planar(*views, threshold=1.5, generator=draw(4))


def points(model: str, **scene: Any) -> Callable[[], Verb]:
    """Points of space before three sensors."""

    def make() -> Verb:
        from dyntorch import scenes

        kind, n = scene.get("kind", "moving_points"), scene.get("n", 60)
        given = {key: value for key, value in scene.items() if key not in ("kind", "n", "threshold")}
        views = getattr(scenes, kind)(n, sigma=0.01, generator=draw(), **given).views
        return lambda: dyn.align_points(*views, model=model, threshold=0.03, generator=draw())

    return make


def lines() -> Verb:
    """Lines of space that translate, two poses of a sensor."""
    from dyntorch import scenes

    views = scenes.translating_lines(60, sigma=0.002, generator=draw()).views
    return lambda: dyn.align_lines(*views, threshold=0.006, generator=draw())


def segment() -> Verb:
    """The traffic of the README: 240 matches, three bodies."""
    from dyntorch import scenes

    views = scenes.bodies((110, 80, 50), bodies=3, sigma=0.4, outliers=0.2, generator=draw(4)).views
    return lambda: dyn.segment(*views, generator=draw(4))


def planes(matches: bool) -> Callable[[], Verb]:
    """Patches that translate by themselves."""

    def make() -> Verb:
        from dyntorch import scenes

        scene = scenes.translating_planes(8, sigma=0.5, generator=draw(4))
        if matches:
            return lambda: dyn.translating_planes(x1=scene.x1, x2=scene.x2)
        return lambda: dyn.translating_planes(scene.homographies)

    return make


def synchronize(correspondence: bool) -> Callable[[], Verb]:
    """Twelve points that wobble, five seconds before two cameras."""

    def make() -> Verb:
        g, t = draw(), torch.arange(150, dtype=torch.float64)[:, None, None] / 30
        speeds, phases, sizes, base = (
            scale * torch.randn(12, 3, generator=g, dtype=torch.float64) for scale in (4.0, 6.0, 1.0, 3.0)
        )

        def film(t: torch.Tensor, turn: float) -> torch.Tensor:
            p = base / 3 + 0.2 * sizes * torch.sin(speeds.abs() * t + phases)
            c, d = math.cos(turn), math.sin(turn)
            x, z = c * p[..., 0] + d * p[..., 2], c * p[..., 2] - d * p[..., 0]
            return 800 * torch.stack([x, p[..., 1]], -1) / (z + 5)[..., None]

        a, b = film(t, 0.0), film(t - 0.42, 1.0)
        return lambda: dyn.synchronize(a, b, correspondence=correspondence, fps=30.0)

    return make


def reconstruct() -> Verb:
    """The lifted scene of the README: 120 points of space, six views."""
    from dyntorch import scenes

    g = draw(5)
    scene = scenes.lifted_points("constant_velocity_3d", 120, views=6, static=0.4, sigma=0.5, outliers=0.05, generator=g)
    known = (scene.labels == 1) & (torch.rand(120, generator=g) < 0.5)
    return lambda: dyn.reconstruct(scene.tracks, "constant_velocity_3d", scene.times, static=known, threshold=1.5)


def reconstruct_pair() -> Verb:
    """A body that bends, before two cameras."""
    from dyntorch.scenes.two_cameras import nonrigid_pair

    scene = nonrigid_pair(12, 10, 90, sigma=0.3, offset=0.41, generator=draw())
    return lambda: dyn.reconstruct_pair(scene.a, scene.b, scene.offset, fps=scene.fps)


def estimate(verb: str) -> Callable[[], Verb]:
    """The homography tensor of one scene: ``fit``, ``robust_fit`` (30 % outliers) or ``refine``."""

    def make() -> Verb:
        from dyntorch import scenes

        outliers = 0.3 if verb == "robust_fit" else 0.0
        views = scenes.planar(n=100, sigma=0.5, outliers=outliers, generator=draw(4)).views
        if verb == "fit":
            return lambda: dyn.fit(dyn.HomographyTensor, *views)
        if verb == "robust_fit":
            return lambda: dyn.robust_fit(dyn.HomographyTensor, *views, threshold=1.5, generator=draw())
        return lambda: dyn.refine(dyn.fit(dyn.HomographyTensor, *views), *views)

    return make


def many() -> Verb:
    """A batch of the README: fits and refinements of 1000 scenes."""
    from dyntorch import scenes

    views = scenes.planar(n=100, batch=1000, sigma=0.5, generator=draw(4)).views
    return lambda: dyn.refine(dyn.fit(dyn.HomographyTensor, *views), *views)


def trajectories() -> Verb:
    """Two hundred points on straight lines before cameras that are known."""
    g = draw()
    cameras = torch.randn(6, 3, 4, generator=g).double()
    start, way = torch.randn(2, 200, 4, generator=g).double()
    x = (start + torch.randn(6, 200, 1, generator=g).double() * way) @ cameras.mT
    return lambda: dyn.triangulate_trajectories(cameras, x[..., :2] / x[..., 2:])


def action(verb: str) -> Callable[[], Verb]:
    """The README's lesson: four actions by one person, recognized in another from the side."""

    def make() -> Verb:
        from indexing import ActionIndexer, actors

        actions = ["squat", "lunge", "jumping_jack", "kick"]
        teacher, other = actors.Person.random(1), actors.Person.random(2)
        lesson = actors.dataset([teacher], actions, azimuth=0, rng=0)
        if verb == "fit":
            return lambda: ActionIndexer().fit(lesson, lesson.labels)
        indexer = ActionIndexer().fit(lesson, lesson.labels)
        asked = actors.dataset([other], actions, azimuth=90, rng=1)
        if verb == "predict":
            return lambda: indexer.predict(asked)
        session = actors.detect(actors.stream([*actions, "squat"], other, rng=3)[0], azimuth=70, rng=3)
        return lambda: getattr(indexer, verb)(session)

    return make


def phase(verb: str) -> Callable[[], Verb]:
    """The README's three actions by three people, frame by frame."""

    def make() -> Verb:
        from indexing import PhaseIndexer
        from indexing.actors import Person, detect, perform

        people, names = [Person.random(seed) for seed in range(3)], ["walk", "sit_down", "kick"]
        train = [detect(perform(name, p, rng=i), azimuth=40.0 * i, rng=i) for i, p in enumerate(people) for name in names]
        if verb == "fit":
            return lambda: PhaseIndexer().fit(train)
        indexer, asked = PhaseIndexer().fit(train), detect(perform("sit_down", Person.random(9), rng=9), azimuth=60.0, rng=9)
        return lambda: indexer.score_frames(asked)

    return make


def brightness(verb: str) -> Callable[[], Verb]:
    """Three actions on film."""

    def make() -> Verb:
        from indexing import BrightnessIndexer
        from indexing.actors import Person, dataset
        from indexing.actors.textured import render_clip

        moves = ["squat", "jumping_jack", "kick"]
        solid = [dataset([Person.random(person)], moves, azimuth=None, rng=person) for person in (1, 2)]
        shown, asked = (
            [render_clip(clip, azimuth=0, rng=i + 10 * k) for i, clip in enumerate(clips)] for k, clips in enumerate(solid)
        )
        if verb == "fit":
            return lambda: BrightnessIndexer(fps=30.0).fit(shown, moves)
        seen = BrightnessIndexer(fps=30.0).fit(shown, moves)
        return lambda: seen.predict(asked)

    return make


VERBS: dict[str, Callable[[], Verb]] = {
    "align_planar": planar,
    'align_points "rigid"': points("rigid", n=20, sensors="rigid"),
    'align_points "join"': points("join", n=80, static=0.3),
    'align_points "minimal_join"': points("minimal_join", n=80, static=0.3),
    'align_points "constant_velocity"': points("constant_velocity", kind="constant_velocity", static=0.3),
    'align_points "affine_constant_velocity"': points(
        "affine_constant_velocity", kind="constant_velocity", sensors="affine", static=0.3
    ),
    "fit": estimate("fit"),
    "robust_fit": estimate("robust_fit"),
    "refine": estimate("refine"),
    "fit and refine, 1000 problems": many,
    "align_lines": lines,
    "segment": segment,
    "translating_planes(H)": planes(matches=False),
    "translating_planes(x1, x2)": planes(matches=True),
    "synchronize": synchronize(correspondence=True),
    "synchronize, different points": synchronize(correspondence=False),
    "reconstruct": reconstruct,
    "reconstruct_pair": reconstruct_pair,
    "triangulate_trajectories": trajectories,
    "ActionIndexer.fit": action("fit"),
    "ActionIndexer.predict": action("predict"),
    "ActionIndexer.score_frames": action("score_frames"),
    "ActionIndexer.find": action("find"),
    "PhaseIndexer.fit": phase("fit"),
    "PhaseIndexer.score_frames": phase("score_frames"),
    "BrightnessIndexer.fit": brightness("fit"),
    "BrightnessIndexer.predict": brightness("predict"),
}
"""Each makes its data and returns the call."""
