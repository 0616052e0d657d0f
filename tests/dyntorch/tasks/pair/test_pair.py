"""Two static cameras that see different, or the same, points of a non-rigid scene, against the scene that made their tracks."""

import pytest
import torch

from dyntorch import PairOptions
from dyntorch.core.outcome import Status
from dyntorch.geometry.homogeneous import skew
from dyntorch.scenes.two_cameras import nonrigid_pair
from dyntorch.tasks.pair import pair
from dyntorch.tasks.pair.pair import reconstruct_pair
from dyntorch.tasks.pair.result import PairNotice
from dyntorch.tasks.synchronize.result import Shift
from tests.grid import grid

N, M, FRAMES = 10, 8, 70


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=seeded(seed), dtype=torch.float64)


def rms(x):
    return float(x.square().sum(-1).mean().sqrt())


def transfer_errors(found, scene):
    """RMS error of b's tracks in a and of a's in b."""
    frames = (found.times * scene.fps).round().long()
    difference = found.images() - scene.images[:, frames]
    return rms(difference[0, :, N:]), rms(difference[1, :, :N])


def affine_error(points, truth):
    """RMS distance of points from the truth after the best single affinity of space, by least squares."""
    x = torch.cat([points.flatten(0, 1), torch.ones(points.shape[0] * points.shape[1], 1, dtype=torch.float64)], dim=-1)
    y = truth.flatten(0, 1)
    return rms(y - x @ torch.linalg.lstsq(x, y).solution)


@pytest.mark.slow
@pytest.mark.parametrize(("planar", "shapes"), [(False, 3), (False, 5), (True, 3)])
def test_exact_tracks_are_transferred_exactly(planar, shapes):
    scene = nonrigid_pair(N, M, FRAMES, shapes=shapes, planar=planar, generator=seeded(1))
    found = reconstruct_pair(scene.a, scene.b, 0.0, fps=scene.fps).check()
    motion = rms(scene.images[0] - scene.images[0].mean(0))
    assert max(transfer_errors(found, scene)) < 1e-6 * motion
    assert found.labels.tolist() == [1] * (N + M) and found.source.tolist() == [0] * N + [1] * M
    assert bool((found.r2 > 1 - 1e-6).all()) and found.residual < 1e-6 * motion
    assert affine_error(found.points, scene.points) < 1e-6 * motion
    views = [torch.linalg.cross(camera[0, :3], camera[1, :3]) for camera in scene.cameras]
    for camera, estimated in zip(scene.cameras, found.normals, strict=True):
        true = torch.nn.functional.normalize(camera[:2, :3] @ torch.linalg.cross(*views), dim=0)
        assert planar or abs(float(true @ estimated)) > 1 - 1e-12
    # the cameras' centres at infinity meet the epipolar normals: both see one coordinate
    values = torch.cat([scene.images[1], torch.ones_like(scene.images[1][..., :1])], -1)
    other = torch.cat([scene.images[0], torch.ones_like(scene.images[0][..., :1])], -1)
    assert float(((values @ found.fundamental) * other).sum(-1).abs().max()) < 1e-6 * motion


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["shift", "times", "other rate"])
def test_clocks(kind):
    scene = nonrigid_pair(N, M, FRAMES, offset=0.4137, generator=seeded(3))
    if kind == "shift":
        empty = torch.zeros(0)
        told = Shift(scene.offset, 0.0, 1.0, 0.0, 1.0, empty, "subspace", (30.0, 30.0), 0.0, empty, empty, status=torch.tensor(0))
        found = reconstruct_pair(scene.a, scene.b, told)
    elif kind == "times":
        clock = torch.arange(FRAMES, dtype=torch.float64) / 30
        found = reconstruct_pair(scene.a, scene.b, scene.offset, times=(clock, clock))
    else:
        found = reconstruct_pair(scene.a, scene.b[::2], scene.offset, fps=(30.0, 15.0))
    first = int(torch.ceil(torch.tensor(-scene.offset * 30))) if scene.offset < 0 else 0
    assert float(found.times[0]) == pytest.approx(first / 30)
    # b's last frame is at (frames - 1) / 30 of its clock
    assert float(found.times[-1]) <= (FRAMES - 1) / 30 - scene.offset
    assert max(transfer_errors(found, scene)) < (0.05 if kind != "other rate" else 2.0)


@pytest.mark.slow
def test_tracks_of_something_else_are_outliers():
    scene = nonrigid_pair(N, M, FRAMES, sigma=0.05, generator=seeded(4))
    walk = normal(FRAMES, 2, 2, seed=5).cumsum(0) * 8
    a, b = scene.a.clone(), scene.b.clone()
    a[:, 3], b[:, 5] = walk[:, 0] + 400, walk[:, 1] + 300
    found = reconstruct_pair(a, b, 0.0, fps=scene.fps)
    assert (found.labels == 0).nonzero().flatten().tolist() == [3, N + 5]
    assert bool(found.points[:, [3, N + 5]].isnan().all()) and bool(found.r2[[3, N + 5]].max() < 0.9)
    kept = found.labels > 0
    difference = (found.images() - scene.images)[:, :, kept]
    assert rms(difference) < 1.0


@pytest.mark.slow
def test_tracks_that_both_cameras_see_are_matched_and_one_tracked_twice_to_neither():
    scene = nonrigid_pair(N, M, FRAMES, sigma=0.1, generator=seeded(6))
    both = scene.images[1, :, [7, 2]] + 0.1 * normal(FRAMES, 2, 2)
    found = reconstruct_pair(scene.a, torch.cat([scene.b, both], dim=1), 0.0, fps=scene.fps)
    assert found.matches.tolist() == [-1] * M + [7, 2]
    assert found.distances.shape == (N, M + 2) and float(found.distances[7, M]) < 3
    twice = torch.cat([scene.a, scene.a[:, 7:8] + 0.1 * normal(FRAMES, 1, 2)], dim=1)
    found = reconstruct_pair(twice, torch.cat([scene.b, scene.images[1, :, [7]]], dim=1), 0.0, fps=scene.fps)
    assert found.matches.tolist() == [-1] * (M + 1)


@pytest.mark.slow
def test_noise_is_amplified_little_and_results_follow_the_input():
    errors = []
    for seed in range(3):
        scene = nonrigid_pair(N, M, FRAMES, sigma=0.3, generator=seeded(seed))
        found = reconstruct_pair(scene.a.float(), scene.b.float(), 0.0, fps=scene.fps)
        errors.append(max(transfer_errors(found, scene)))
        assert 0.1 < found.residual < 0.6 and int(found.labels.sum()) == N + M
    assert sum(errors) / 3 < 1.5
    assert found.points.dtype == found.cameras.dtype == found.r2.dtype == torch.float32 and found.times.dtype == torch.float64
    assert repr(found).startswith("PairReconstruction(affine, frames=70, points=18: OK)")


@pytest.mark.slow
def test_missing_positions():
    scene = nonrigid_pair(N, M, FRAMES, sigma=0.05, generator=seeded(7))
    a, b = scene.a.clone(), scene.b.clone()
    for k in range(N):
        a[5 * k : 5 * k + 12, k] = torch.nan
    b[20:30, 2], b[:, 6] = torch.nan, torch.nan
    found = reconstruct_pair(a, b, 0.0, fps=scene.fps)
    assert found.labels.tolist() == [1] * (N + 6) + [0, 1]
    assert bool(found.r2[N + 6].isnan())
    kept = found.labels > 0
    assert rms((found.images() - scene.images)[:, :, kept]) < 0.05 * rms(scene.images[0] - scene.images[0].mean(0))


@pytest.mark.slow
def test_free_mean_places_are_noticed():
    scene = nonrigid_pair(N, M, FRAMES, shapes=3, generator=seeded(8))
    moved = scene.b + 60 * normal(1, M, 2)
    found = reconstruct_pair(scene.a, moved, 0.0, fps=scene.fps)
    assert [notice.code for notice in found.warnings] == [PairNotice.FREE_PLACES]
    seen, truth = found.images()[0, :, N:], scene.images[0, :, N:]
    seen, truth = seen - seen.mean(0), truth - truth.mean(0)
    # up to the scale of b's motions, which nothing fixes then
    scale = (seen * truth).sum() / seen.square().sum()
    assert rms(scale * seen - truth) < 1e-5 * rms(truth)


def perspective(points, rotation, translation):
    camera = torch.tensor([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]], dtype=torch.float64)
    seen = (points @ rotation.T + translation) @ camera.T
    return seen[..., :2] / seen[..., 2:]


@pytest.fixture(scope="module")
def crowd():
    """Points that move anyhow before two perspective cameras, and the true fundamental matrix."""
    points = normal(40, 9, 3, seed=1).cumsum(0) * 0.05 + normal(9, 3, seed=2) + torch.tensor([0.0, 0.0, 6.0])
    rotation = torch.linalg.matrix_exp(skew(torch.tensor([0.05, 0.6, 0.02], dtype=torch.float64)))
    translation = torch.tensor([-3.3, 0.3, 1.2], dtype=torch.float64)
    inverse = torch.linalg.inv(torch.tensor([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]], dtype=torch.float64))
    F = inverse.T @ skew(translation) @ rotation @ inverse
    a = perspective(points, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    return points, a, perspective(points, rotation, translation), F / F.norm()


def test_corresponding_points_are_reconstructed_up_to_one_collineation(crowd):
    points, a, b, F = crowd
    a = a.clone()
    a[4:9, 1] = torch.nan
    found = reconstruct_pair(a, b, 0.0, True, fps=30.0, generator=seeded()).check()
    assert abs(float((found.fundamental * F).sum())) > 1 - 1e-9
    assert found.points.shape == (40, 9, 4) and found.labels.tolist() == [1] * 9 == (found.matches >= 0).long().tolist()
    assert bool(found.points[4:9, 1].isnan().all()) and int(found.points.isnan().any(-1).sum()) == 5
    seen = found.points.isfinite().all(-1)
    assert float((found.images()[0] - crowd[1])[seen].abs().max()) < 1e-6
    # the collineation from five points and more, linearly, carries all frames to the truth
    flat, truth = found.points[seen], torch.cat([points, torch.ones_like(points[..., :1])], -1)[seen]
    rows = torch.einsum("nqj,nl->nqjl", _pairs(truth), flat).flatten(2).flatten(0, 1)
    H = torch.linalg.svd(rows, full_matrices=False).Vh[-1].unflatten(0, (4, 4))
    moved = flat @ H.T
    assert float((moved[:, :3] / moved[:, 3:] - truth[:, :3]).abs().max()) < 1e-5


def _pairs(y):
    """``(n, 6, 4)``: y_i e_j - y_j e_i, which vanish on multiples of y."""
    out = torch.zeros(len(y), 6, 4, dtype=torch.float64)
    for k, (i, j) in enumerate([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]):
        out[:, k, j], out[:, k, i] = y[:, i], -y[:, j]
    return out


def test_wrong_corresponding_points_are_flagged_and_too_few_refused(crowd):
    _, a, b, _ = crowd
    few = reconstruct_pair(a[:, :2] * torch.nan, b[:, :2], 0.0, True, fps=30.0)
    assert few.status == Status.TOO_FEW and few.points.shape == (40, 2, 4)
    b = b.clone() + 0.3 * normal(*b.shape)
    b[:, 3], b[:, 6] = b[:, 4], b[:, 6].flip(0)
    found = reconstruct_pair(a, b, 0.0, True, fps=30.0, generator=seeded())
    assert (found.labels == 0).nonzero().flatten().tolist() == [3, 6]
    assert float(found.residuals[3]) > 10 * found.residual and 0.1 < found.residual < 0.4


@pytest.mark.parametrize(
    ("change", "status", "code"),
    [
        (lambda s: (s.a[:8], s.b[:8], 0.0), Status.TOO_FEW, PairNotice.SHORT_OVERLAP),
        (lambda s: (s.a, s.b, 60.0), Status.TOO_FEW, PairNotice.SHORT_OVERLAP),
        (lambda s: (s.a[:, :1], s.b, 0.0), Status.TOO_FEW, PairNotice.FEW_POINTS),
        (lambda s: (torch.full_like(s.a, torch.nan), s.b, 0.0), Status.TOO_FEW, PairNotice.FEW_POINTS),
        (lambda s: (s.a[:1].expand(FRAMES, -1, -1), s.b, 0.0), Status.DEGENERATE, PairNotice.STATIC_SCENE),
        (lambda s: (s.a[:1] + 0.2 * normal(FRAMES, N, 2), s.b, 0.0), Status.DEGENERATE, PairNotice.STATIC_SCENE),
        (lambda s: (s.a[:14], s.b[:14], 0.0), Status.TOO_FEW, PairNotice.SHORT_OVERLAP),
        (
            lambda s: (s.a, nonrigid_pair(N, M, FRAMES, sigma=0.1, generator=seeded(99)).b, 0.0),
            Status.NO_CONSENSUS,
            PairNotice.FEW_POINTS,
        ),
        (
            lambda s: (s.a, (s.b @ torch.tensor([[0.6], [0.8]]).double()) * torch.tensor([0.6, 0.8]), 0.0),
            Status.DEGENERATE,
            PairNotice.COLLINEAR,
        ),
    ],
)
def test_data_that_cannot_decide_say_so(change, status, code):
    scene = nonrigid_pair(N, M, FRAMES, sigma=0.1, generator=seeded(10))
    a, b, shift = change(scene)
    found = reconstruct_pair(a, b, shift, fps=30.0)
    assert found.status == status and [notice.code for notice in found.warnings] == [code]
    assert bool(found.points.isnan().all()) and not bool(found.labels.any()) and not bool(found.cameras.any())
    assert code in repr(found) and len(repr(found).splitlines()) == 2
    with pytest.raises(ValueError, match=str(code)):
        found.check()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"a": [[1.0]]}, r"a must be a floating point tensor \(frames, points, 2\), got list"),
        ({"b": torch.zeros(5, 3)}, r"b must be a floating point tensor"),
        ({"b": torch.zeros(FRAMES, M, 2, dtype=torch.int64)}, r"got \(70, 8, 2\) torch.int64"),
        ({"shift": "0.1"}, r"shift must be a Shift or an offset in seconds"),
        ({"shift": float("nan")}, r"shift must be finite"),
        ({"fps": None}, r"needs fps= or times="),
        ({"fps": 0.0}, r"fps of a must be a positive"),
        ({"fps": (30.0, 30.0, 30.0)}, r"one number or two"),
        ({"times": (torch.arange(3.0), torch.arange(3.0))}, r"either fps or times"),
        ({"fps": None, "times": (torch.arange(3.0), torch.arange(FRAMES))}, r"times of a must be 70 finite seconds"),
        ({"correspondence": True}, r"as many in a as in b, got 10 and 8"),
        ({"correspondence": 1}, r"correspondence must be True or False"),
        ({"explained": 1.5}, r"explained must be a share"),
        ({"threshold": -1.0}, r"threshold must be a positive"),
        ({"options": {}}, r"options must be PairOptions, got \{\}; use dataclasses\.replace"),
    ],
)
def test_misuse(change, said):
    scene = nonrigid_pair(N, M, FRAMES, generator=seeded())
    given = {"a": scene.a, "b": scene.b, "shift": 0.0, "fps": 30.0} | change
    with pytest.raises(ValueError, match=said):
        reconstruct_pair(**given)


@pytest.mark.slow
def test_unrelated_bodies_are_not_explained_by_each_other():
    # smooth motions of many points explain any smooth motion: all but one in a hundred of it, in stretches that were left out
    def wandering(points, generator):
        draw = torch.randn(180, points + 1, 2, generator=generator, dtype=torch.float64).cumsum(0)
        window = torch.exp(-0.5 * (torch.arange(-30, 31, dtype=torch.float64) / 8) ** 2)
        smooth = (draw.unfold(0, 61, 1) * window / window.sum()).sum(-1)
        places = 100 * torch.randn(1, points, 2, generator=generator, dtype=torch.float64)
        noise = 0.5 * torch.randn(120, points, 2, generator=generator, dtype=torch.float64)
        return places + 4 * smooth[:, :1] + 1.2 * smooth[:, 1:] + noise

    for seed in (7000, 7003):
        generator = torch.Generator().manual_seed(seed)
        found = reconstruct_pair(wandering(12, generator), wandering(14, generator), 0.0, fps=30.0)
        assert found.status == Status.NO_CONSENSUS and not found.labels.any()
        assert found.warnings[0].code == PairNotice.CHANCE


@pytest.mark.parametrize("camera", [0, 1])
@grid(("scale", [1e-160, 1e70, 1e160, 1e300]))
def test_coordinates_of_any_size_are_a_status(scale, camera):
    scene = nonrigid_pair(8, 8, 40, sigma=0.3, generator=seeded())
    tracks = [x * scale if i == camera else x for i, x in enumerate((scene.a, scene.b))]
    found = reconstruct_pair(*tracks, scene.offset, fps=scene.fps)
    assert found.status == (Status.TOO_FEW if scale > 1 else Status.NO_CONSENSUS)
    assert [notice.code for notice in found.warnings] == [PairNotice.FEW_POINTS]


@pytest.mark.slow
def test_options_decide():
    scene = nonrigid_pair(N, M, FRAMES, sigma=0.3, generator=seeded(3))
    hidden = scene.b.clone()
    hidden[: FRAMES // 3, :2] = torch.nan

    def status(b=scene.b, **options):
        return int(reconstruct_pair(scene.a, b, 0.0, fps=scene.fps, options=PairOptions(**options)).status)

    assert status() == Status.OK
    assert status(min_frames=FRAMES + 1) == Status.TOO_FEW
    assert status(min_chance_margin=1e9) == Status.NO_CONSENSUS
    # the margin counts in ranges of the likelihoods that were drawn
    assert status(num_chance_draws=2, min_chance_margin=1.0) == Status.OK
    found = [
        reconstruct_pair(scene.a, hidden, 0.0, fps=scene.fps, options=PairOptions(min_seen_share=share)) for share in (0.5, 0.9)
    ]
    assert bool(found[0].labels[N : N + 2].all()) and not bool(found[1].labels[N : N + 2].any())


@pytest.mark.slow
def test_the_fundamental_matrix_is_estimated_from_so_many_positions(monkeypatch):
    scene, sizes = nonrigid_pair(N, N, FRAMES, sigma=0.3, generator=seeded(3)), []
    search = pair.robust_fit

    def counted(kind, x1, x2, **given):
        sizes.append(len(x1))
        return search(kind, x1, x2, **given)

    monkeypatch.setattr(pair, "robust_fit", counted)
    for count in (4000, 100):
        reconstruct_pair(scene.a, scene.a + 1.0, 0.0, True, fps=scene.fps, options=PairOptions(max_samples=count))
    assert sizes == [N * FRAMES, N * FRAMES // (-(-N * FRAMES // 100))]
