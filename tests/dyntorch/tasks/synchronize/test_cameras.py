"""Clocks of several cameras from pairs: against networks of known clocks, closed forms and brute force."""

from itertools import combinations

import pytest
import torch

from dyntorch.core.outcome import Notice, NoticeCode, Status, status_from
from dyntorch.tasks.synchronize.cameras import combine_shifts, synchronize_cameras
from dyntorch.tasks.synchronize.result import Shift

NONE = torch.zeros(0)
LAGS = torch.linspace(-5, 5, 301, dtype=torch.float64)


class Told(NoticeCode):
    PERIODIC = "periodic", "the motion is periodic", Status.AMBIGUOUS
    APART = "apart", "no overlap", Status.TOO_FEW


def shift(offset, *others, rate=1.0, center=0.0, sigma=0.01, rate_sigma=0.0, ok=True, confidence=0.97, fps=30.0):
    """A pair whose shift at ``center`` is ``offset``, with other peaks."""
    peaks = torch.tensor([[value, 1.0 - 0.1 * k] for k, value in enumerate((offset, *others))], dtype=torch.float64)
    limits = () if ok else (Notice(Told.PERIODIC),)
    start = offset - center * (rate - 1)
    return Shift(
        start, sigma, rate, rate_sigma, confidence, peaks, "epipolar", (fps, fps), center, LAGS, torch.zeros_like(LAGS),
        status=status_from(limits), notices=limits,
    )  # fmt: skip


def network(offsets, rates=None, noise=0.0, center=20.0, seed=0, **more):
    """Shifts of all pairs of cameras with given clocks."""
    generator = torch.Generator().manual_seed(seed)
    rates = [1.0] * len(offsets) if rates is None else rates
    found = {}
    for i, j in combinations(range(len(offsets)), 2):
        error, drift = (noise * torch.randn(2, generator=generator, dtype=torch.float64)).tolist()
        rate = rates[j] / rates[i]
        value = (center - offsets[i]) * rate + offsets[j] - center + error
        rate *= 1 + (drift * 1e-3 if rates[i] != rates[j] else 0.0)
        found[i, j] = shift(value, rate=rate, center=center, **more)
    return found


def test_exact_pairs_give_exact_clocks_whenever_they_count_from():
    offsets, rates = [0.0, 1.25, -3.5, 0.75], [1.0, 1 + 4e-5, 1 - 3e-5, 1 + 1e-5]
    clocks = combine_shifts(network(offsets, rates, rate_sigma=1e-5), 4)
    assert torch.allclose(clocks.offsets, torch.tensor(offsets, dtype=torch.float64), atol=1e-9)
    assert torch.allclose(clocks.rates, torch.tensor(rates, dtype=torch.float64), rtol=0, atol=1e-12)
    assert clocks.ok and clocks.outliers == [] and clocks.cycle_error < 1e-9
    assert all(row.is_used and abs(row.residual) < 1e-9 for row in clocks.pairs)
    offsets = [0.0, 1.25, -3.5, 7.0]
    clocks = combine_shifts(network(offsets, [1.0, 1 + 2e-5, 1.0, 1.0], center=1.7e9, rate_sigma=1e-5), 4)
    moment = clocks.at(clocks.center)
    rates = torch.tensor([1.0, 1 + 2e-5, 1.0, 1.0], dtype=torch.float64)
    truth = clocks.center * rates + torch.tensor(offsets, dtype=torch.float64)
    assert torch.allclose(moment, truth, rtol=0, atol=1e-5)
    assert clocks.center == pytest.approx(1.7e9, abs=2e-5 * 1.7e9)


def test_any_camera_is_the_reference_and_clocks_convert():
    offsets, rates = [0.0, 1.25, -3.5], [1.0, 1.01, 0.998]
    pairs = network(offsets, rates, rate_sigma=1e-5)
    first, last = combine_shifts(pairs, 3), combine_shifts(pairs, 3, reference=2)
    assert (float(last.offsets[2]), float(last.rates[2]), float(last.sigmas[2])) == (0.0, 1.0, 0.0)
    moments = torch.tensor([0.0, 30.0], dtype=torch.float64)
    assert torch.allclose(last.at(first.at(moments)[2]), first.at(moments), atol=1e-9)
    assert torch.allclose(first.inverse(1, first.at(moments)[1]), moments, atol=1e-9)


def test_least_squares_equal_the_normal_equations():
    pairs = network([0.0, 1.0, 2.0, -1.0], noise=0.004, seed=3)
    sigmas = torch.linspace(0.01, 0.06, 6, dtype=torch.float64)
    pairs = {
        ends: shift(float(p.peaks[0, 0]), center=20.0, sigma=float(s)) for (ends, p), s in zip(pairs.items(), sigmas, strict=True)
    }
    clocks = combine_shifts(pairs, 4)
    weight = 0.97 / (sigmas**2 + (0.1 * 0.25 / 30) ** 2)
    rows = torch.zeros(6, 4, dtype=torch.float64)
    for row, (i, j) in enumerate(pairs):
        rows[row, i], rows[row, j] = -1.0, 1.0
    values = torch.stack([p.peaks[0, 0] for p in pairs.values()])
    normal = rows[:, 1:].T @ (weight[:, None] * rows[:, 1:])
    expected = torch.linalg.solve(normal, rows[:, 1:].T @ (weight * values))
    assert torch.allclose(clocks.offsets[1:], expected, atol=1e-7)
    residual = rows[:, 1:] @ expected - values
    scale = max(1.0, float((weight * residual.square()).sum()) / 3)
    assert torch.allclose(clocks.sigmas[1:], (torch.linalg.inv(normal).diagonal() * scale).sqrt(), rtol=1e-5)


@pytest.mark.slow
def test_sigmas_are_those_of_repeated_trials():
    truth = torch.tensor([0.0, 1.0, -2.0, 0.5, 3.0], dtype=torch.float64)
    trials = [combine_shifts(network(truth.tolist(), noise=0.01, seed=seed), 5) for seed in range(20)]
    errors = torch.stack([one.offsets - truth for one in trials])[:, 1:]
    claimed = torch.stack([one.sigmas for one in trials])[:, 1:]
    assert 0.75 < float(errors.square().mean().sqrt() / claimed.square().mean().sqrt()) < 1.25


def test_drifting_clocks_are_best_known_in_the_middle():
    rates = [1.0, 1 + 4e-5, 1 - 3e-5, 1 + 1e-5]
    pairs = {}
    for start, center in enumerate((20.0, 60.0, 100.0)):
        for (i, j), one in network([0.0, 1.0, 2.0, 3.0], rates, center=center, rate_sigma=2e-5).items():
            if (i + j) % 3 == start:
                pairs[i, j] = one
    clocks = combine_shifts(pairs, 4)
    assert 20 < clocks.center < 100
    assert torch.allclose(clocks.rates, torch.tensor(rates, dtype=torch.float64), rtol=0, atol=1e-10)
    assert (clocks.rate_sigmas[1:] > 5e-6).all() and (clocks.rate_sigmas[1:] < 3e-5).all()


@pytest.mark.parametrize("wrong", [(0, 1), (1, 3), (2, 3)])
def test_a_pair_off_by_a_period_is_named(wrong):
    pairs = network([0.0, 1.25, -1.5, 0.75], noise=0.003)
    pairs[wrong] = shift(float(pairs[wrong].peaks[0, 0]) + 0.533, center=20.0)
    clocks = combine_shifts(pairs, 4)
    assert clocks.ok and clocks.outliers == [wrong]
    assert torch.allclose(clocks.offsets, torch.tensor([0.0, 1.25, -1.5, 0.75], dtype=torch.float64), atol=0.02)
    row = next(row for row in clocks.pairs if row.cameras == wrong)
    assert not row.is_used and row.residual == pytest.approx(0.533, abs=0.02)
    assert any("contradicts the others by +0.5" in note for note in clocks.notes)
    text = repr(clocks)
    assert text.startswith("Clocks(4 cameras, cycle error 0.00") and "camera 0: +0.0000 ± 0.0000 s, the reference" in text
    assert f"pair {wrong[0]}-{wrong[1]}: " in text and "contradicts the others, not used" in text


def test_a_wrong_pair_whose_second_peak_fits_takes_part_with_it():
    pairs = network([0.0, 1.25, -1.5, 0.75])
    value = float(pairs[0, 2].peaks[0, 0])
    pairs[0, 2] = shift(value - 0.6, value, value + 0.6, center=20.0)
    clocks = combine_shifts(pairs, 4)
    assert clocks.ok and clocks.outliers == [(0, 2)]
    assert next(row.peak for row in clocks.pairs if row.cameras == (0, 2)) == 1
    assert clocks.cycle_error < 1e-9


def test_a_pair_off_by_a_period_or_a_rate_is_named():
    truth = [0.0, 1.25, -1.5, 0.75, 2.0, -3.0]
    pairs = network(truth, noise=0.003)
    for ends, error in {(0, 1): 1.1, (3, 5): -0.55}.items():
        pairs[ends] = shift(float(pairs[ends].peaks[0, 0]) + error, center=20.0)
    clocks = combine_shifts(pairs, 6)
    assert clocks.ok and clocks.outliers == [(0, 1), (3, 5)]
    assert torch.allclose(clocks.offsets, torch.tensor(truth, dtype=torch.float64), atol=0.02)
    # and a pair of a wrong rate
    pairs = network([0.0, 1.25, -1.5, 0.75], [1.0, 1 + 3e-5, 1.0, 1 - 3e-5], rate_sigma=1e-5)
    pairs[1, 2] = shift(float(pairs[1, 2].peaks[0, 0]) + 0.2, rate=1.01, center=20.0, rate_sigma=1e-5)
    assert combine_shifts(pairs, 4).outliers == [(1, 2)]
    pairs = network([0.0, 1.0, 2.0, 3.0])
    pairs[2, 3] = shift(1.012, center=20.0)
    clocks = combine_shifts(pairs, 4)
    ((triple, error), expected) = clocks.worst_cycle, 0.012
    assert {2, 3} < set(triple) and abs(error) == pytest.approx(expected)
    assert clocks.cycle_error == pytest.approx(expected / 2**0.5)


def test_a_triangle_cannot_tell_which_pair_is_wrong():
    pairs = network([0.0, 1.25, -1.5])
    pairs[1, 2] = shift(float(pairs[1, 2].peaks[0, 0]) + 0.6, center=20.0)
    clocks = combine_shifts(pairs, 3)
    assert not clocks.ok and clocks.confidence < 0.7
    assert "contradict each other" in clocks.reason
    with pytest.raises(ValueError, match="synchronize_cameras: camera"):
        clocks.check()


def test_the_third_camera_resolves_what_two_cannot():
    truth, period = [0.0, 1.2, -0.7], 0.55
    pairs = network(truth)
    value = float(pairs[1, 2].peaks[0, 0])
    pairs[1, 2] = shift(value + period, value - period, value, value + 2 * period, center=20.0, ok=False, confidence=0.3)
    clocks = combine_shifts(pairs, 3)
    assert clocks.ok and clocks.outliers == []
    assert torch.allclose(clocks.offsets, torch.tensor(truth, dtype=torch.float64), atol=1e-6)
    assert any("pair 1-2 refused on its own; the others confirm its peak number 3" in note for note in clocks.notes)
    # the same pair, and only one sure one: a camera that nothing but periodic pairs ties
    pairs[0, 2] = shift(-0.7, -0.7 + period, -0.7 - period, center=20.0, ok=False, confidence=0.3)
    clocks = combine_shifts(pairs, 3)
    assert not clocks.ok and "camera 2: too few sure pairs, 0-2, 1-2 refused (the motion is periodic)" in clocks.reason


def test_refused_pairs_agree_at_one_place_only():
    pairs = network([0.0, 1.2, -0.7, 2.0])
    pairs[0, 3] = shift(0.31, 2.0, 1.1, center=20.0, ok=False, confidence=0.3)
    pairs[1, 3] = shift(2.33, -1.9, 0.8, center=20.0, ok=False, confidence=0.3)
    pairs[2, 3] = shift(-0.4, -1.44, 2.7, center=20.0, ok=False, confidence=0.3)
    clocks = combine_shifts(pairs, 4)
    assert clocks.ok and clocks.outliers == []
    assert float(clocks.offsets[3]) == pytest.approx(2.0, abs=1e-6)
    assert [row.peak for row in clocks.pairs if 3 in row.cameras] == [1, 2, 2]


def test_pairs_that_failed_or_agree_nowhere_leave_the_camera_undecided():
    pairs = network([0.0, 1.2, -0.7])
    pairs[0, 2] = shift(0.31, -0.9, 1.9, center=20.0, ok=False, confidence=0.3)
    pairs[1, 2] = shift(-2.4, -0.2, 2.6, center=20.0, ok=False, confidence=0.3)
    clocks = combine_shifts(pairs, 3)
    assert not clocks.ok and clocks.reason.startswith("camera 2: too few sure pairs")
    assert float(clocks.offsets[1]) == pytest.approx(1.2)
    assert clocks.offsets.isfinite().all()
    pairs = network([0.0, 1.2, -0.7])
    nan = float("nan")
    none = torch.zeros(0, 2), "epipolar", (30.0, 30.0), nan, NONE, NONE
    pairs[1, 2] = Shift(nan, nan, nan, nan, nan, *none, status=torch.tensor(1), notices=(Notice(Told.APART),))
    clocks = combine_shifts(pairs, 3)
    assert clocks.ok and "cameras 1, 2: tied by one pair alone, which nothing checks" in clocks.notes
    assert torch.allclose(clocks.offsets, torch.tensor([0.0, 1.2, -0.7], dtype=torch.float64), atol=1e-9)
    pairs[0, 2] = pairs[1, 2]
    clocks = combine_shifts(pairs, 3)
    assert not clocks.ok and clocks.reason.startswith("no pair leads from the reference to camera 2")
    vague = shift(0.5, ok=False, sigma=float("inf"), confidence=0.4)
    clocks = combine_shifts({**network([0.0, 1.2]), (0, 2): vague, (1, 2): vague}, 3)
    assert not clocks.ok and clocks.offsets.isfinite().all()


@pytest.mark.slow
def test_random_peaks_are_never_taken_for_an_answer():
    """Of refused pairs whose peaks are anywhere, few agree by chance."""
    answered = 0
    for seed in range(12):
        values = torch.rand(6, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 10 - 5
        ends = combinations(range(4), 2)
        pairs = {one: shift(*row, ok=False, confidence=0.4) for one, row in zip(ends, values.tolist(), strict=True)}
        answered += combine_shifts(pairs, 4).ok
    assert answered == 0


def test_a_disconnected_camera_has_no_clock():
    pairs = {ends: one for ends, one in network([0.0, 1.2, -0.7, 2.0, 2.5]).items() if ends in [(0, 1), (0, 2), (1, 2), (3, 4)]}
    clocks = combine_shifts(pairs, 5)
    assert not clocks.ok and clocks.reason.startswith("no pair leads from the reference to cameras 3, 4")
    assert clocks.offsets.isnan().tolist() == clocks.sigmas.isinf().tolist() == [False, False, False, True, True]
    assert torch.allclose(clocks.offsets[:3], torch.tensor([0.0, 1.2, -0.7], dtype=torch.float64), atol=1e-9)


def test_two_cameras_are_their_pair():
    clocks = combine_shifts({(0, 1): shift(0.4, center=12.0, rate=1 + 1e-4, rate_sigma=1e-5)}, 2)
    assert clocks.ok and clocks.worst_cycle is None and clocks.cycle_error != clocks.cycle_error
    assert float(clocks.at(12.0)[1]) == pytest.approx(12.4)
    assert clocks.center == pytest.approx(12.0)
    assert float(clocks.sigmas[1]) == pytest.approx(0.01, rel=0.05)
    assert "nothing checks the pair" in clocks.notes[0]
    refused = combine_shifts({(0, 1): shift(0.4, 0.9, ok=False, confidence=0.4)}, 2)
    assert (refused.ok, refused.reason) == (False, "the motion is periodic")


def stand_in(a, b, correspondence, *, max_shift=None, fps=None, **more):
    if not len(b):
        raise ValueError("b: no frames")
    assert correspondence is False and max_shift == 3.0 and more["smooth"] == 2
    return shift(float(b[0, 0, 0] - a[0, 0, 0]), fps=min(fps))


def test_all_pairs_are_compared_each_with_its_cameras_own():
    tracks = [torch.full((4, n, 2), value) for n, value in ((3, 0.0), (5, 1.5), (4, -2.0))]
    clocks = synchronize_cameras(tracks, False, fps=(30, 60, 25), max_shift=3.0, smooth=2, pair=stand_in)
    assert clocks.offsets.round(decimals=9).tolist() == [0.0, 1.5, -2.0]
    assert [one.fps[0] for one in clocks.shifts.values()] == [30, 25, 25]
    some = synchronize_cameras(tracks, False, fps=30, max_shift=3.0, smooth=2, pair=stand_in, pairs=[(0, 1), (1, 2)])
    assert list(some.shifts) == [(0, 1), (1, 2)] and some.ok


TRACKS = [torch.zeros(4, 3, 2), torch.zeros(4, 3, 2), torch.zeros(0, 3, 2)]


def pairs_of(**more):
    return synchronize_cameras(TRACKS, False, max_shift=3.0, smooth=2, pair=stand_in, **more)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: pairs_of(fps=(30, 30)), "fps: 2 values for 3 cameras"),
        (lambda: pairs_of(calibration=[None]), "calibration: 1 values for 3 cameras"),
        (lambda: pairs_of(fps=30, pairs=[(0, 3)]), r"pair \(0, 3\): give two different cameras out of 0..2"),
        (lambda: pairs_of(fps=30), "cameras 0 and 2: b: no frames"),
        (lambda: synchronize_cameras(TRACKS[:1], fps=30), "tracks: 1 camera given"),
        (lambda: combine_shifts({}, 2), "no pair of cameras is given"),
        (lambda: combine_shifts({(0, 0): None}, 2), "give two different"),
        (lambda: combine_shifts({(0, 1): None}, 1), "at least two cameras"),
    ],
)
def test_misuse_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
