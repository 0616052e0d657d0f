"""The scene before cameras of known calibration: its metric frame, bundle adjustment within it, and what remains open."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.core.outcome import Note, Status, in_order, is_failure, noting
from dyntorch.geometry.bundle import CalibratedCameras, bundle_adjust
from dyntorch.geometry.homogeneous import nonzero_sign
from dyntorch.geometry.lift import change_frame, steadiest_frame
from dyntorch.geometry.triangulation import unit_projections
from dyntorch.numerics.blocks import select
from dyntorch.tasks.reconstruct.diagnosis import NOISE_ROUNDING, unknowns
from dyntorch.tasks.reconstruct.metric import WorldChanges, metric_frames
from dyntorch.tasks.reconstruct.motions import Motion
from dyntorch.tasks.reconstruct.result import Reconstruction, ReconstructNotice
from dyntorch.tasks.reconstruct.scene import COST_TOLERANCE, LiftedState, Lifting, ViewTracks, distances, positions, velocities


@dataclass(frozen=True)
class Stage:
    """The space that the constants live in: that of a lift, or of two bodies with a column of their own each."""

    motion: Motion
    lifts: Tensor
    """``(views, a + 1, K)``."""
    changes: WorldChanges
    world: Tensor
    """``(s, K)`` homogeneous coordinates of the points."""
    middle: Tensor | None
    """The lift at the mean time, where a common velocity may be open."""
    still: Tensor | None
    """The constants of points that stand still, where some may be known to."""

    @classmethod
    def of_lift(cls, lifting: Lifting) -> Stage:
        """Of a motion with a lift."""
        motion, lifts = lifting.motion, lifting.lifts
        still = lifting.still if lifting.still.shape[-1] else None
        return cls(motion, lifts, WorldChanges.of(lifts, lifting.algebra, motion.dim), lifting.middle[-1:], lifting.middle, still)

    @classmethod
    def of_bodies(cls, motion: Motion, like: Tensor, views: int) -> Stage:
        """Of two bodies: cameras ``[Q | q_1 | q_2]``, points ``(X, 1, 0)`` and ``(X, 0, 1)``, up to an affinity of each."""
        d, size = motion.dim, motion.dim + 2
        eye = torch.eye(size, dtype=like.dtype, device=like.device)
        # the linear part is common, each body has a place (and in space a size) of its own
        entries = [(i, j) for i in range(d) for j in range(size)] + [(d, d), (d + 1, d + 1)]
        algebra = torch.stack([eye[i, :, None] * eye[j] for i, j in entries])
        lifts = eye.expand(views, size, size)
        return cls(motion, lifts, WorldChanges.of(lifts, algebra, d), eye[d:], None, None)

    @property
    def freedom(self) -> int:
        """Dimensions of what calibrated cameras leave open."""
        if self.motion.bodies > 1:  # one turn, a place of each body, and their sizes
            return (3 if self.motion.dim == 3 else 1) + 2 * self.motion.dim + 2
        return len(self.changes.similar) - 1 - (self.motion.sensor == 3)

    def unknowns(self, views: Tensor) -> Tensor:
        """Unknowns of all calibrated cameras less what is open."""
        return views * (6 + 3 * (self.motion.bodies - 1)) - self.freedom


MAX_MISFIT = 5.0  # the same from which on the scene stays without calibration


def metric_reconstruction(
    plain: Reconstruction, tracks: ViewTracks, scene: LiftedState, lifting: Lifting | None, labels: Tensor, calibration: Tensor
) -> Reconstruction:
    """A reconstruction in the metric frame of its cameras, where there is one; elsewhere as it is, with the reason. labels
    ``(b, n)``, calibration ``(b, views, l + 1, l + 1)``."""
    motion, batch = plain.motion, tuple(plain.status.shape)
    stage = Stage.of_bodies(motion, tracks.x, tracks.x.shape[1]) if lifting is None else Stage.of_lift(lifting)
    status = plain.status.reshape(-1)
    solved = ~is_failure(status)
    found = metric_scene(tracks, scene, stage, labels, tracks.transforms @ calibration, solved)
    projections = found.cameras @ stage.lifts
    apart = distances(tracks, projections, found.structure)
    counted = apart.isfinite()
    total = torch.where(counted, apart.square(), 0.0).flatten(1).sum(-1)
    number = counted.flatten(1).sum(-1)
    points_free = torch.where(counted.any(1), unknowns(tracks, motion), 0).sum(-1)
    spare = number * motion.sensor - points_free - stage.unknowns(counted.any(-1).sum(-1))
    sigma = (total / spare.clamp(min=1)).sqrt()
    before = plain.sigma.reshape(-1)
    floor = NOISE_ROUNDING / tracks.scale()
    worse = (sigma + floor) / (before + floor)
    more, note = noting(batch)
    metric_notices(found, worse, stage, solved, note)
    found = replace(found, found=found.found & (worse <= MAX_MISFIT))
    known = found.found.to(sigma.dtype)[:, None, None, None]
    found = replace(found, rotations=found.rotations * known, translations=found.translations * known)
    status = torch.where(found.found & (found.several > 1) & (status == Status.OK), int(Status.AMBIGUOUS), status)
    back = torch.linalg.inv(tracks.transforms)
    structure, bodies, shown = found.structure, plain.bodies, back @ found.cameras
    if lifting is None:
        inside = (structure != 0).any(-1, keepdim=True)
        points, speed = torch.where(inside, structure[..., : motion.dim], torch.nan), None
        pair = torch.stack([torch.cat([shown[..., :-2], shown[..., body - 2, None]], dim=-1) for body in range(2)], dim=1)
        shown, projections = pair[:, 0], shown
        assert bodies is not None
        bodies = _where(found.found, unit_projections(pair), bodies)
    else:
        points = positions(structure, lifting.start)
        speed = velocities(structure, lifting.start, lifting.slope)
        structure, projections = structure @ lifting.back.mT, back @ projections @ lifting.root
    poses = found.translations.permute(0, 3, 1, 2)  # of bodies one each
    return replace(
        plain,
        cameras=_where(found.found, unit_projections(shown), plain.cameras),
        points=_where(found.found, points, plain.points),
        velocities=None if speed is None or plain.velocities is None else _where(found.found, speed, plain.velocities),
        residual=_where(found.found, (total / number.clamp(min=1)).sqrt(), plain.residual),
        residuals=_where(found.found, apart, plain.residuals),
        sigma=_where(found.found, sigma, plain.sigma),
        status=status.reshape(batch),
        structure=_where(found.found, structure, plain.structure),
        projections=_where(found.found, unit_projections(projections), plain.projections),
        ambiguity=_ambiguity_text(plain, found.found, tracks.static is not None),
        notices=in_order((*plain.notices, *more)),
        bodies=bodies,
        metric=found.found.reshape(batch),
        rotations=found.rotations.reshape(*batch, *found.rotations.shape[1:]),
        translations=(poses if motion.bodies > 1 else poses[:, 0]).reshape(
            *batch, *(poses.shape[1:] if motion.bodies > 1 else poses.shape[2:])
        ),
        calibration=calibration.reshape(*batch, *calibration.shape[1:]),
    )


def _where(found: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """The new values of a flat batch in the shape of the old ones, where there are any."""
    return select(found, new, old.reshape(new.shape)).reshape(old.shape)


def _ambiguity_text(plain: Reconstruction, found: Tensor, static: bool) -> str:
    """What remains unknown with the calibration."""
    if not bool(found.any()):
        return plain.ambiguity
    motion = plain.motion
    text = f"known up to {motion.metric_open or 'a similarity and what of the motion is common to all points'}"
    if motion.lift is not None and not motion.static and motion.k > motion.dim:
        text += (
            "; the given static points fix the common motion" if static else "; the frame is the one in which the points move least"
        )
    whole = bool(found.all())
    return text if whole else f"{text}; where no metric frame was found: {plain.ambiguity}"


@dataclass(frozen=True)
class MetricScene:
    """Cameras and points in the metric frame; as they were where there is none."""

    cameras: Tensor
    """``(b, views, l + 1, a + 1)`` in normalized images."""
    structure: Tensor
    """``(b, n, K)``."""
    found: Tensor
    """``(b,)`` bool."""
    several: Tensor
    """``(b,)`` how many metric frames fit."""
    weakness: Tensor
    """``(b,)`` how well the frame is determined, 0 where a family of frames is metric."""
    doubt: Tensor
    """``(b,)`` expected relative error of the metric."""
    rotations: Tensor
    """``(b, views, 3, 3)``."""
    translations: Tensor
    """``(b, views, 3, s)``."""


MIN_WEAKNESS = 1e-5  # singular value over the largest below which a family of frames is metric


def metric_scene(tracks: ViewTracks, scene: LiftedState, stage: Stage, labels: Tensor, K: Tensor, solved: Tensor) -> MetricScene:
    """The metric frame of solved problems, adjusted within cameras of the known calibrations. labels ``(b, n)``, K
    ``(b, views, l + 1, l + 1)``, solved ``(b,)``."""
    b, views = tracks.x.shape[:2]
    d, wide = stage.motion.dim, stage.changes.worlds.shape[-1] - stage.motion.dim
    result = MetricScene(
        scene.cameras.clone(),
        scene.structure.clone(),
        torch.zeros_like(solved),
        torch.ones_like(solved, dtype=torch.long),
        torch.full_like(scene.cost, torch.inf),
        torch.zeros_like(scene.cost),
        scene.cameras.new_zeros(b, views, 3, 3),
        scene.cameras.new_zeros(b, views, 3, wide),
    )
    sound = solved & scene.cameras.isfinite().flatten(1).all(-1) & scene.structure.isfinite().flatten(1).all(-1)
    left = sound.nonzero()[:, 0]
    if not len(left):
        return result
    some, K, cameras, structure = tracks.subset(left), K[left], scene.cameras[left], scene.structure[left]
    seen = (some.weights > 0).any(-1)[..., None, None]
    bare = unit_projections(torch.linalg.solve_ex(K, cameras)[0]) * seen
    frames = metric_frames(bare, structure, stage.lifts, stage.changes, stage.world, some.weights)
    known = CalibratedCameras(K, d)
    inverse = torch.linalg.inv_ex(frames.change)[0]
    inverse = _lengths(bare, inverse, frames.change, stage) if stage.motion.sensor == 3 else inverse
    cameras, structure = change_frame(inverse, cameras, structure, stage.lifts)
    cameras, structure = _adjust(some, cameras, structure, stage, labels[left], known)
    cameras, structure = _fix_frame(some, cameras, structure, stage, labels[left], known)
    cameras, turn, rest = _poses(some, cameras, structure, stage, known)
    good = cameras.isfinite().flatten(1).all(-1) & structure.isfinite().flatten(1).all(-1) & (frames.weakness > MIN_WEAKNESS)
    doubt = frames.misfit / frames.weakness.clamp(min=MIN_WEAKNESS)
    at = left[good]
    result.cameras[at], result.structure[at], result.found[at] = cameras[good], structure[good], True
    result.rotations[at], result.translations[at] = turn[good], rest[good]
    result.several[left], result.weakness[left], result.doubt[left] = frames.several, frames.weakness, doubt
    return result


def _lengths(bare: Tensor, inverse: Tensor, change: Tensor, stage: Stage) -> Tensor:
    """The change of frame with the lengths that sensors measure."""
    lifts = stage.lifts
    placed = bare @ lifts @ change[:, None] @ torch.linalg.pinv(lifts)
    placed = placed / placed[..., 3:, 3:]
    hand = nonzero_sign(torch.linalg.det(placed[..., :3, :3]).sign().sum(-1))
    size = torch.linalg.svdvals(placed[..., :3, :3]).mean((-2, -1)) * hand
    world = torch.diag_embed(torch.cat([size[:, None].expand(-1, 3), torch.ones_like(size[:, None])], -1))
    return _of_world(world, lifts) @ inverse


def _of_world(world: Tensor, lifts: Tensor) -> Tensor:
    """The change of the constants ``(b, K, K)`` that makes a change of the world ``(b, a + 1, a + 1)`` at all views."""
    return torch.linalg.pinv(lifts.flatten(0, 1)) @ (world[:, None] @ lifts).flatten(1, 2)


METRIC_ITERATIONS = 60  # of bundle adjustment with calibrated cameras


def _adjust(
    tracks: ViewTracks, cameras: Tensor, structure: Tensor, stage: Stage, labels: Tensor, known: CalibratedCameras
) -> tuple[Tensor, Tensor]:
    """Bundle adjustment with calibrated cameras, from the nearest ones."""
    confined, subspace = None, None
    if stage.motion.bodies > 1:
        size = stage.lifts.shape[-1]
        eye = torch.eye(size, dtype=cameras.dtype, device=cameras.device)
        own = [[*range(size - 2), size - 2 + body] for body in range(2)]
        confined, subspace = labels, torch.stack([eye[:, place] for place in own])
    elif tracks.static is not None and stage.still is not None:
        confined, subspace = tracks.static, stage.still
    done = bundle_adjust(
        tracks.x,
        tracks.weights,
        known.nearest(cameras),
        structure,
        stage.lifts,
        iterations=METRIC_ITERATIONS,
        tolerance=COST_TOLERANCE,
        confined=confined,
        subspace=subspace,
        calibration=known.matrices,
        turned=known.turned,
    )
    return done.cameras, done.structure


def _fix_frame(
    tracks: ViewTracks, cameras: Tensor, structure: Tensor, stage: Stage, labels: Tensor, known: CalibratedCameras
) -> tuple[Tensor, Tensor]:
    """The metric scene with no mirrored cameras, no motion common to all points, centred and (before cameras) of unit size."""
    lifts, world = stage.lifts, stage.world
    d, there = stage.motion.dim, (structure != 0).any(-1)
    inside = structure @ world.mT  # (b, n, s)
    below = inside.sum(-1)
    structure = structure / torch.where(below.abs() > 1e-12, below, 1.0)[..., None]
    if stage.motion.sensor == 2:
        cameras, structure = _remove_mirrors(tracks, cameras, structure, stage, labels, known)
    if stage.middle is not None:
        static = tracks.static
        still = there if static is None else torch.where((there & static).any(-1, keepdim=True), there & static, there)
        G = steadiest_frame(structure, lifts, stage.middle, stage.changes.metric, still.to(structure.dtype))
        cameras, structure = change_frame(G, cameras, structure, lifts)
    size = lifts.shape[1]
    for body in range(stage.motion.bodies):
        mine = there if stage.motion.bodies == 1 else there & (labels == body + 1)
        place = structure[:, None] @ lifts.mT
        count = (mine.sum(-1) * len(lifts)).clamp(min=1)[:, None]
        points = torch.where(mine[:, None, :, None], place[..., :d] / place[..., d:].sum(-1, keepdim=True), 0.0)
        mean = points.sum((1, 2)) / count
        off = torch.where(mine[:, None, :, None], points - mean[:, None, None], 0.0)
        spread = (off.square().sum((1, 2, 3)) / count[:, 0] / d).sqrt().clamp(min=1e-300)
        change = torch.eye(size, dtype=structure.dtype, device=structure.device).repeat(len(structure), 1, 1)
        change[:, :d, d + body] = -mean
        if stage.motion.sensor == 2 and body == 0:
            # the size of the second body is that of the first, or in space anything: the same
            change[:, :d] = change[:, :d] / spread[:, None, None]
        cameras, structure = change_frame(_of_world(change, lifts), cameras, structure, lifts)
    return cameras, structure


def _remove_mirrors(
    tracks: ViewTracks, cameras: Tensor, structure: Tensor, stage: Stage, labels: Tensor, known: CalibratedCameras
) -> tuple[Tensor, Tensor]:
    """The scene in front of its cameras, with rotations of determinant 1: a world may be seen in a mirror, a body from behind."""
    d, lifts = stage.motion.dim, stage.lifts
    turn = known.parts(cameras)[0]
    depth = (structure[:, None] @ (cameras @ lifts)[..., -1, :, None])[..., 0] * (tracks.weights > 0)
    first = labels == 1 if stage.motion.bodies > 1 else torch.ones_like(labels, dtype=torch.bool)
    hand = torch.linalg.det(turn) if d == 3 else (depth.sign() * first[:, None]).sum(-1)
    depth = depth * nonzero_sign(hand)[..., None]
    change = torch.eye(lifts.shape[1], dtype=structure.dtype, device=structure.device).repeat(len(structure), 1, 1)
    for body in range(stage.motion.bodies):
        mine = labels == body + 1 if stage.motion.bodies > 1 else torch.ones_like(labels, dtype=torch.bool)
        side = nonzero_sign((depth.sign() * mine[:, None]).sum((1, 2)))
        if stage.motion.bodies == 1:
            change[:, :d] = change[:, :d] * (side[:, None, None] if d == 3 else 1.0)
        else:
            change[:, d + body, d + body] = side
    cameras, structure = change_frame(_of_world(change, lifts), cameras, structure, lifts)
    below = (structure @ stage.world.mT).sum(-1)
    return cameras, structure / torch.where(below.abs() > 1e-12, below, 1.0)[..., None]


def of_bodies(bodies: Tensor, points: Tensor, labels: Tensor) -> LiftedState:
    """Cameras ``[Q | q_1 | q_2]`` and points of two bodies with their cameras ``(b, 2, views, 3, d + 1)`` of one linear part."""
    first, second = bodies.unbind(1)
    linear, other = first[..., :-1], second[..., :-1]
    size = (linear * other).sum((-2, -1)) / other.square().sum((-2, -1)).clamp(min=1e-300)
    cameras = torch.cat([first, second[..., -1:] * size[..., None, None]], dim=-1)
    own = torch.stack([labels == 1, labels == 2], dim=-1).to(points.dtype)
    structure = torch.cat([points, own], dim=-1)
    structure = torch.where((points.isfinite().all(-1) & (labels > 0))[..., None], structure, 0.0)
    return LiftedState(unit_projections(cameras), structure, torch.zeros_like(points[:, 0, 0]))


def _poses(
    tracks: ViewTracks, cameras: Tensor, structure: Tensor, stage: Stage, known: CalibratedCameras
) -> tuple[Tensor, Tensor, Tensor]:
    """Cameras :math:`K [R_{:d} | t]` of either norm 1 or zero, rotations ``(b, v, 3, 3)`` and translations ``(b, v, 3, s)``."""
    turn, rest = known.parts(cameras)
    d = stage.motion.dim
    seen = (tracks.weights > 0).any(-1)[..., None, None].to(cameras.dtype)
    if stage.motion.sensor == 2:
        depth = (structure[:, None] @ (cameras @ stage.lifts)[..., -1, :, None])[..., 0] * (tracks.weights > 0)
        sign = nonzero_sign(torch.linalg.det(turn) if d == 3 else depth.sign().sum(-1))[..., None, None]
        turn, rest = turn * sign, rest * sign
    if d == 2:
        turn = torch.cat([turn, torch.linalg.cross(turn[..., 0], turn[..., 1], dim=-1)[..., None]], dim=-1)
    return unit_projections(known.nearest(cameras)) * seen, turn * seen, rest * seen


NOTED_METRIC_DOUBT = 0.5  # of the entries before adjustment: below, points are off by .1 to .4 % after it, above by up to 10 %
NOTED_MISFIT = 1.5  # noise with calibrated cameras over that without, from which on the calibration is doubted


def metric_notices(found: MetricScene, worse: Tensor, stage: Stage, solved: Tensor, note: Note) -> None:
    """Where no metric frame was found, where several were, and where the calibration does not fit. worse ``(b,)``, solved
    ``(b,)``."""
    case = "plane" if stage.motion.dim == 2 else "space"
    family = solved & ~found.found & (found.weakness <= MIN_WEAKNESS)
    fits, poor = worse <= MAX_MISFIT, worse > NOTED_MISFIT
    note(ReconstructNotice.METRIC_FAMILY, found.weakness, family, case=case)
    note(ReconstructNotice.METRIC_UNCERTAIN, found.doubt, found.found & fits & ~poor & (found.doubt > NOTED_METRIC_DOUBT))
    note(ReconstructNotice.METRIC_SEVERAL, found.several, found.found & fits & (found.several > 1), case=case)
    note(ReconstructNotice.CALIBRATION, worse, found.found & fits & poor)
    note(ReconstructNotice.CALIBRATION, worse, found.found & ~fits, case="none")
