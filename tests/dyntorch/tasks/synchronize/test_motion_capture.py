"""A camera against motion capture: known offsets in either order, what must not matter, and what is refused."""

import math

import pytest
import torch
from scipy.linalg import eigh

from dyntorch import synchronize, synchronize_cameras
from dyntorch.numerics.lags import resection_moments
from dyntorch.tasks.synchronize.motion_capture import SpaceDescent, camera_variance, fit_combination
from dyntorch.tasks.synchronize.result import SynchronizeOptions
from dyntorch.tasks.synchronize.tracks import read_tracks
from tests.draws import seeded

FPS, RECORDED = 30.0, 120.0
OFFSET = 1.2345


def normal(*shape, generator):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def motion_of(seed, points=12, walk=0.5, period=None):
    """Points that wobble about a person who walks, metres, y up; one that repeats itself where a period is given."""
    generator = seeded(seed)
    base = normal(points, 3, generator=generator) * torch.tensor([0.25, 0.5, 0.25])
    own = 0.2 + 1.3 * torch.rand(4, points, 3, generator=generator)
    cycles = (torch.arange(1, 5)[:, None, None] / period if period else own).double()
    phases, sizes = 6.3 * torch.rand(4, points, 3, generator=generator), 0.1 * normal(4, points, 3, generator=generator)
    to_and_fro = 0.0 if period else walk

    def motion(times):
        turns = 2 * math.pi * cycles * times[:, None, None, None]
        places = base + (sizes * torch.sin(turns + phases)).sum(1)
        way = torch.stack([torch.sin(0.9 * times), torch.zeros_like(times), torch.cos(0.4 * times)], dim=-1)
        return places + to_and_fro * way[:, None]

    return motion


def seen_by(places, turn=0.7, focal=1100.0, noise=0.0, generator=None):
    """Pixels of a camera 4.5 m away that looks at the middle of the room."""
    c, s = math.cos(turn), math.sin(turn)
    rotation = torch.tensor([[c, 0, s], [0, -1, 0], [s, 0, -c]], dtype=torch.float64)
    local = places @ rotation.T + torch.tensor([0.0, 0.0, 4.5], dtype=torch.float64)
    pixels = focal * local[..., :2] / local[..., 2:] + torch.tensor([960.0, 540.0], dtype=torch.float64)
    return pixels + noise * normal(*pixels.shape, generator=generator) if noise else pixels


def taken(seed=0, seconds=4.0, recorded=8.0, offset=OFFSET, fps=(FPS, RECORDED), rate=1.0, noise=3.0, **kind):
    """A film, and what was recorded around it in space: the time of the record is the film's * rate + offset."""
    motion = motion_of(seed, **kind)
    film = torch.arange(round(seconds * fps[0]), dtype=torch.float64) / fps[0]
    space = torch.arange(round(recorded * fps[1]), dtype=torch.float64) / fps[1]
    return seen_by(motion(rate * film + offset), noise=noise, generator=seeded(100 + seed)), motion(space)


@pytest.mark.parametrize(("noise", "within"), [(0.0, 0.01), (4.0, 0.1)])
def test_the_offset_is_found_between_frames_whichever_comes_first(noise, within):
    film, space = taken(1, noise=noise)
    shift = synchronize(film, space, fps=(FPS, RECORDED))
    assert shift.ok and shift.method == "camera" and shift.rate == 1 and shift.fps == pytest.approx((FPS, RECORDED))
    assert abs(shift.offset - OFFSET) < within / FPS and abs(shift.offset - OFFSET) < 5 * shift.sigma
    back = synchronize(space, film, fps=(RECORDED, FPS))
    assert back.ok and abs(back.offset + OFFSET) < within / FPS and back.peaks[0, 0] == pytest.approx(back.offset, abs=1e-6)
    motion = motion_of(1)(torch.tensor([2.0, 3.5], dtype=torch.float64))
    for one in (shift, back) if not noise else ():
        assert one.projection.shape == (3, 4) and float(one.projection.norm()) == pytest.approx(1) and one.fundamental is None
        images = torch.cat([motion, torch.ones(*motion.shape[:2], 1)], -1) @ one.projection.T
        assert float((images[..., :2] / images[..., 2:] - seen_by(motion)).abs().max()) < 0.5


@pytest.mark.parametrize("change", ["millimetres", "z up", "far away", "mirrored"])
def test_unit_axes_and_origin_of_the_space_do_not_matter(change):
    film, space = taken(3)
    other = {
        "millimetres": 1000 * space,
        "z up": space[..., [2, 0, 1]],
        "far away": space + torch.tensor([100.0, -40.0, 7.0], dtype=torch.float64),
        "mirrored": space * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64),
    }[change]
    plain, changed = (synchronize(film, x, fps=(FPS, RECORDED)) for x in (space, other))
    assert changed.ok and changed.offset == pytest.approx(plain.offset, abs=1e-4)
    assert changed.sigma == pytest.approx(plain.sigma, rel=0.05)


@pytest.mark.slow
def test_gaps_outliers_and_a_wrong_point_do_not_matter():
    film, space = taken(4)
    generator = seeded(5)
    film[torch.rand(film.shape[:2], generator=generator) < 0.1] = torch.nan
    astray = torch.rand(film.shape[:2], generator=generator) < 0.05
    film[astray] = 1000 * torch.rand(int(astray.sum()), 2, generator=generator, dtype=torch.float64)
    space[200:260, 3] = torch.nan
    space[:, 7] = motion_of(40)(torch.arange(len(space), dtype=torch.float64) / RECORDED)[:, 0]
    shift = synchronize(film, space, fps=(FPS, RECORDED))
    assert shift.ok and abs(shift.offset - OFFSET) < 0.2 / FPS
    assert shift.points.tolist() == [k != 7 for k in range(12)]
    assert any("7" in note for note in shift.notes)


def test_clocks_that_run_at_other_rates_are_found():
    film, space = taken(5, seconds=20.0, recorded=24.0, rate=1.002, fps=(25.0, 60.0))
    shift = synchronize(film, space, fps=(25.0, 60.0))
    assert shift.ok and abs(shift.rate - 1.002) < max(4 * shift.rate_sigma, 1e-5)
    middle = 10.0
    assert abs(float(shift.at(middle)) - 1.002 * middle - OFFSET) < 0.2 / 25


def test_times_of_any_era_and_a_lens_that_is_known():
    film, space = taken(6)
    K = torch.tensor([[1100.0, 0, 960], [0, 1100, 540], [0, 0, 1]], dtype=torch.float64)
    times = (5e5 + torch.arange(len(film)).double() / FPS, torch.arange(len(space)).double() / RECORDED)
    shift = synchronize(film, space, times=times, calibration=((K, torch.zeros(4).double()), None))
    assert shift.ok and float(shift.at(5e5)) == pytest.approx(OFFSET, abs=0.1 / FPS)
    with pytest.raises(ValueError, match="calibration of b: it holds points in space; give None for it"):
        synchronize(film, space, fps=(FPS, RECORDED), calibration=(None, (K, None)))
    assert not synchronize(film, space, fps=(FPS, RECORDED), options=SynchronizeOptions(min_margin=50.0)).ok


@pytest.mark.slow
@pytest.mark.parametrize("seed", [7, 8])
def test_films_of_something_else_are_refused(seed):
    film, space = taken(seed)
    _, other = taken(seed + 20)
    assert not synchronize(film.flip(0), space, fps=(FPS, RECORDED)).ok
    assert not synchronize(film, other, fps=(FPS, RECORDED)).ok


@pytest.mark.slow
def test_what_repeats_itself_or_stands_is_refused():
    film, space = taken(9, period=1.0)
    shift = synchronize(film, space, fps=(FPS, RECORDED))
    assert not shift.ok and "repeats" in shift.reason
    wobble = 3 * normal(120, 12, 2, generator=seeded(3))
    still = seen_by(motion_of(9)(torch.zeros(1).double()))
    for tracks in (still.expand(120, -1, -1), still + wobble):
        assert not synchronize(tracks, space, fps=(FPS, RECORDED)).ok


@pytest.mark.slow
def test_different_points_in_any_axes():
    """Points of both hang on the same six that move: none of one is one of the other."""
    generator, six = seeded(10), motion_of(10, points=6)

    def hung(times, count):
        shares = torch.rand(count, 6, generator=generator, dtype=torch.float64).square()
        places = 0.3 * normal(count, 3, generator=generator)
        return places + torch.einsum("nk,tkd->tnd", shares / shares.sum(1, keepdim=True), six(times))

    space = hung(torch.arange(1440, dtype=torch.float64) / RECORDED, 14)
    film = hung(OFFSET + torch.arange(240, dtype=torch.float64) / FPS, 10)
    film = seen_by(film, noise=2.0, generator=seeded(1))
    for places in (space, 1000 * space[..., [2, 0, 1]]):
        shift = synchronize(film, places, correspondence=False, fps=(FPS, RECORDED))
        assert shift.ok and shift.points is None and abs(shift.offset - OFFSET) < 0.5 / FPS
    back = synchronize(space, film, correspondence=False, fps=(RECORDED, FPS))
    assert back.ok and abs(back.offset + OFFSET) < 0.5 / FPS
    assert not synchronize(film.flip(0), space, correspondence=False, fps=(FPS, RECORDED)).ok


def test_several_cameras_and_motion_capture_on_one_clock():
    motion = motion_of(11)
    clocks = (0.0, 0.4321, -1.0)
    films = [
        seen_by(motion(2 + torch.arange(120).double() / FPS - clock), turn, noise=2.0, generator=seeded(i))
        for i, (clock, turn) in enumerate(zip(clocks[:2], (0.2, 1.4), strict=True))
    ]
    space = motion(torch.arange(720).double() / RECORDED)
    found = synchronize_cameras([*films, space], fps=[FPS, FPS, RECORDED])
    assert found.ok and found.cycle_error < 0.2 / FPS
    assert found.offsets.tolist() == pytest.approx([0.0, 0.4321, 2.0], abs=0.1 / FPS)
    assert [found.shifts[ends].method for ends in ((0, 1), (0, 2), (1, 2))] == ["epipolar", "camera", "camera"]


def test_batches_are_loops():
    films, spaces = zip(*(taken(seed, seconds=3.0, recorded=5.0, fps=(FPS, 60.0)) for seed in (12, 13)), strict=True)
    both = synchronize(torch.stack(films), torch.stack(spaces), fps=(FPS, 60.0))
    alone = synchronize(films[1], spaces[1], fps=(FPS, 60.0))
    assert both.ok.all() and float(both.problem(1).offset) == pytest.approx(alone.offset, abs=1e-9)
    assert both.projection.shape == (2, 3, 4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (lambda film, space: ((space, space), {}), "a and b both hold points in space"),
        (lambda film, space: ((film, space), {"camera": "affine"}), "camera='affine' is for two cameras"),
        (lambda film, space: ((film, space[:, :5]), {}), r"a has 12 points and b 5.*correspondence=False"),
        (lambda film, space: ((film[..., None].expand(-1, -1, -1, 4)[..., 0, :], space), {}), r"\(frames, points, 2\), got"),
    ],
)
def test_misuse_names_the_remedy(arguments, words):
    given, more = arguments(*taken(0, seconds=1.0, recorded=2.0))
    with pytest.raises(ValueError, match=words):
        synchronize(*given, fps=(FPS, RECORDED), **more)


def test_the_variance_is_the_least_generalized_eigenvalue_of_the_12_by_12_moments():
    film, space = taken(14, noise=6.0, fps=(FPS, FPS), offset=1.0)
    x, X = (film - film.mean((0, 1))) / 200, space[30 : 30 + len(film)] - space.mean((0, 1))
    variance, camera = camera_variance(resection_moments(x, X, (0, 0))[0][0])
    one = torch.cat([X, torch.ones(*X.shape[:2], 1)], -1).flatten(0, 1)
    zero, flat = torch.zeros_like(one), x.flatten(0, 1)
    rows = torch.cat([torch.cat([one, zero, -flat[:, :1] * one], 1), torch.cat([zero, one, -flat[:, 1:] * one], 1)])
    depth = torch.cat([zero, zero, one], 1)
    above, below = rows.T @ rows, 2 * depth.T @ depth
    # the largest of the inverse pencil: the divisor has no full rank, the moments have
    values = eigh(below.numpy(), above.numpy(), eigvals_only=True)
    assert float(variance) == pytest.approx(1 / values[-1], rel=1e-6)
    p = camera.flatten()
    assert float(p @ above @ p / (p @ below @ p)) == pytest.approx(float(variance), rel=1e-6)
    flat = X * torch.tensor([1.0, 1.0, 0.0])  # points in a plane have a variance, and nothing has none
    assert 0 < float(camera_variance(resection_moments(x, flat, (0, 0))[0])[0]) < math.inf
    nothing, camera = camera_variance(torch.zeros(2, 4, 4, 4, dtype=torch.float64))
    assert nothing.isinf().all() and (camera == 0).all()


@pytest.mark.parametrize("swapped", [False, True])
def test_the_derivatives_are_those_of_the_residuals(swapped):
    film, space = taken(17, noise=0.0)
    a, b = (read_tracks(n, x, f, None, None) for n, x, f in (("a", film, FPS), ("b", space, RECORDED)))
    offset = -OFFSET if swapped else OFFSET
    descent = SpaceDescent(*((b, a) if swapped else (a, b)), 1 / FPS)
    at, ahead = (descent._match(offset + d, 1.0) for d in (0.0, 1e-4))
    times = torch.zeros(len(at.p), dtype=torch.float64)
    camera = descent._solve(descent._moments(at)[None])[1][0]
    rows = descent._residuals(camera, at, times)
    changed = descent._residuals(camera, ahead, times)
    numeric = (changed.residual - rows.residual) / 1e-4
    assert float((numeric - rows.along).abs().median()) < 0.03 * float(rows.along.abs().median())
    step = 1e-6 * normal(3, 4, generator=seeded())
    moved = descent._residuals(camera + step, at, times).residual - rows.residual
    assert torch.allclose(rows.products @ step.flatten(), moved, atol=1e-3 * float(moved.abs().max()))


@pytest.mark.parametrize("start", [-0.8, 0.6])
def test_combinations_of_what_was_recorded_tell_the_place_between_frames(start):
    film, space = taken(20, points=8, noise=2.0)
    seen = motion_of(20, points=8)(OFFSET + torch.arange(120, dtype=torch.float64) / FPS)
    between = torch.stack([seen[:, [k, k + 1, k + 2]].mean(1) for k in range(6)], dim=1)
    film = seen_by(between, noise=2.0, generator=seeded(3))
    a, b = (read_tracks(n, x, f, None, None) for n, x, f in (("a", film, FPS), ("b", space, RECORDED)))
    found = fit_combination(a, b, OFFSET + start / FPS, 1.0)
    assert abs(found.offset - OFFSET) < 0.2 / FPS and abs(found.offset - OFFSET) < 4 * found.sigma
    assert found.residual < 4 and found.weights.shape[0] == 6
    nothing = read_tracks("a", torch.full((40, 3, 2), torch.nan), FPS, None, None)
    assert fit_combination(nothing, b, 0.0, 1.0) is None
