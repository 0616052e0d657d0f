"""Which frames are compared: pairs near and far, the tracks that both show, and how well these are measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from dyntorch.geometry.epipolar import PairMonomials
from dyntorch.geometry.homogeneous import similarity
from dyntorch.tasks.segment.coherence import Links, View

Pair = tuple[int, int]


LENGTH_QUANTILE = 0.75  # of the tracks, that the widest pairs of frames have
NUM_GAP_HALVINGS = 4  # near pairs show short tracks, far ones more motion
MIN_FRAME_PAIRS = 12  # compared, where there are so many
MEAN_PAIRS_PER_TRACK = 5.0  # at least, where the most pairs allow it
MIN_COMMON_TRACKS = 20  # that both frames of a pair must show
DOUBLED_VARIANCE_MOTION = 2.0  # pixels between two frames at which the variance of a track has doubled
STACKED = 1 << 17  # numbers of the sightings of pairs of frames that are taken together: 1 MB each of what comes between
MAX_CUT_SURVIVAL = 0.2  # share of the tracks of a frame that live on in the next one, at a cut
MIN_JUMPING_SHARE = 0.5  # of the tracks, at a cut
MIN_JUMP = 12.0  # over the median motion of tracks between all other frames


@dataclass(frozen=True)
class FramePair:
    """Two frames, and the tracks that both show."""

    frames: Pair  # their numbers, the earlier one first
    index: Tensor  # ``(m,)`` of these tracks
    view: View  # their places, without links
    precision: Tensor  # ``(m,)`` in [0, 1]: the inverse variance of a track beside that of one that does not move


@dataclass(frozen=True)
class PairStack:
    """Several pairs of frames side by side, so that a few large operations serve all of them."""

    index: Tensor  # ``(p, m)`` the tracks that both frames of a pair show; pairs with fewer of them are filled up
    present: Tensor  # ``(p, m)`` bool, what is no filling
    view: View  # ``(p, m, 2)`` their places, without links
    precision: Tensor  # ``(p, m)`` as in :class:`FramePair`, 0 for fillings
    usual: Tensor  # ``(p,)`` the median precision
    weight: Tensor  # ``(p, m)`` in fits: by their precision, of mean 1

    @staticmethod
    def of(pairs: Sequence[FramePair]) -> PairStack:
        """All of them."""
        index, x1, x2, precision, weight = (
            pad_sequence(list(part), batch_first=True)
            for part in zip(
                *((one.index, one.view.x1, one.view.x2, one.precision, one.precision / one.precision.mean()) for one in pairs),
                strict=True,
            )
        )
        sizes = torch.tensor([len(pair.index) for pair in pairs], device=index.device)
        present = torch.arange(index.shape[1], device=index.device) < sizes[:, None]
        usual = torch.stack([pair.precision.median() for pair in pairs])
        return PairStack(index, present, replace(pairs[0].view, x1=x1, x2=x2), precision, usual, weight)

    @cached_property
    def monomials(self) -> PairMonomials:
        """Of their places."""
        return PairMonomials(self.view.x1, self.view.x2)

    def split(self, width: int) -> list[PairStack]:
        """As few parts as ``width`` numbers for each sighting allow."""
        count = max(1, STACKED // max(1, width * self.index.shape[1]))
        if count >= len(self.index):
            return [self]
        parts = (self.index, self.present, self.view.x1, self.view.x2, self.precision, self.usual, self.weight)
        return [
            PairStack(index, present, replace(self.view, x1=x1, x2=x2), *rest)
            for index, present, x1, x2, *rest in zip(*(part.split(count) for part in parts), strict=True)
        ]

    def members(self, groups: Tensor) -> Tensor:
        """Groups ``(*batch, n)`` as ``(p, *batch, m)``, 0 for fillings."""
        return (groups[..., self.index].double() * self.present).movedim(-2, 0)


@dataclass(frozen=True)
class TrackSet:
    """The tracks of one problem, centred and of about unit size, all frames alike."""

    x: Tensor  # ``(frames, n, 2)``, 0 where a track is missing
    seen: Tensor  # ``(frames, n)`` bool
    pixel: float  # a pixel of the options, in these coordinates
    change: Tensor  # ``(3, 3)`` similarity from pixels to them

    @staticmethod
    def of(tracks: Tensor, pixel: float = 1.0) -> TrackSet:
        """Of tracks ``(frames, n, 2)``, NaN = missing, in whose unit a pixel of the options is so long."""
        seen = tracks.isfinite().all(-1)
        there = tracks[seen]
        centre = there.median(0).values
        distance = torch.hypot(*(there - centre).unbind(-1))
        spread = distance[distance > 0].median() if bool(distance.any()) else torch.ones_like(distance[0])
        scale = 1 / spread
        x = torch.where(seen[..., None], (tracks - centre) * scale, 0.0)
        return TrackSet(x, seen, pixel * float(scale), similarity(scale, centre))

    @cached_property
    def ends(self) -> tuple[Tensor, Tensor]:
        """``(n,)`` the first and the last frame that shows a track; of one that none shows the last is before the first."""
        number = torch.arange(len(self.seen), device=self.seen.device)[:, None]
        return torch.where(self.seen, number, len(self.seen)).amin(0), torch.where(self.seen, number, -1).amax(0)

    @cached_property
    def lengths(self) -> Tensor:
        """``(n,)`` frames from the first to the last that show a track."""
        first, last = self.ends
        return (last - first + 1).clamp(min=0)

    def pair(self, frames: Pair) -> FramePair:
        """Two frames."""
        first, second = frames
        index = (self.seen[first] & self.seen[second]).nonzero().flatten()
        x1, x2 = self.x[first][index], self.x[second][index]
        moved = (x2 - x1).norm(dim=-1) / self.pixel
        none = Links(index[:, None][:, :0], x1[:, :0])
        return FramePair(frames, index, View(x1, x2, self.pixel, none), 1 / (1 + moved / DOUBLED_VARIANCE_MOTION))


def space_pairs(count: int, gap: int, most: int) -> list[Pair]:
    """Up to ``most`` pairs of ``count`` frames with a gap, from the first to the last."""
    last = count - 1 - gap
    number = min(most, last + 1)
    places = torch.linspace(0, last, number).round().long().tolist() if number > 1 else [last // 2] * (number == 1)
    return [(a, a + gap) for a in places]


def select_near_pairs(film: TrackSet, gaps: tuple[int, ...], starts: int, common: int) -> list[Pair]:
    """Pairs of frames with the given gaps, evenly spread; in a video longer than its tracks there are more of them."""
    count = len(film.seen)
    length = float(film.lengths.double().median())
    most = round(starts * max(1.0, count / max(length, 4.0) / 1.5))
    pairs = dict.fromkeys(pair for gap in gaps for pair in space_pairs(count, min(gap, count - 1), most))
    return [(a, b) for a, b in pairs if int((film.seen[a] & film.seen[b]).sum()) >= common]


def select_frame_pairs(film: TrackSet, max_pairs: int) -> list[Pair]:
    """The pairs of frames that bodies are judged by: wide ones, narrower ones for short tracks, all tracks in some of them."""
    count = len(film.seen)
    common = min(MIN_COMMON_TRACKS, max(8, film.x.shape[1] // 2))
    gap = int(min(count - 1, max(1.0, float(film.lengths.double().quantile(LENGTH_QUANTILE)) - 1)))
    offered: dict[Pair, Tensor] = {}
    for _ in range(NUM_GAP_HALVINGS):
        step = max(1, gap // 2)
        for a in {*range(0, count - gap, step), count - 1 - gap}:
            both = film.seen[a] & film.seen[a + gap]
            if int(both.sum()) >= common:
                offered[a, a + gap] = both
        gap = max(1, gap // 2)
    if not offered:
        return []
    pairs = list(offered)
    both = torch.stack([offered[pair] for pair in pairs]).double()
    wide = torch.tensor([float(b - a) for a, b in pairs], dtype=both.dtype, device=both.device).sqrt()
    have, selected = torch.zeros_like(both[0]), torch.zeros(len(pairs), dtype=torch.bool, device=both.device)
    alive = int((both.sum(0) > 0).sum())
    while not bool(selected.all()) and int(selected.sum()) < max_pairs:
        if int(selected.sum()) >= MIN_FRAME_PAIRS and float(have.sum()) >= MEAN_PAIRS_PER_TRACK * alive:
            break
        gain = (both @ (1 / (1 + have)) * wide).masked_fill(selected, -1.0)
        best = int(gain.argmax())
        selected[best] = True
        have += both[best]
    return sorted(pair for pair, taken in zip(pairs, selected.tolist(), strict=True) if taken)


@dataclass(frozen=True)
class SceneCut:
    """Where a video goes on with another scene: the first frame of that, and the share of the tracks that go on, or how many times
    farther they jump than elsewhere (0: few go on)."""

    frame: int
    share: float
    jump: float = 0.0


def find_scene_cut(film: TrackSet) -> SceneCut | None:
    """The first cut of a video, if there is one."""
    first, last = film.ends
    steps = []
    for frame in range(1, len(film.seen)):
        before, after = (first < frame) & (last >= frame - 1), (first <= frame) & (last >= frame)
        across = before & after
        least = float(torch.minimum(before.sum(), after.sum()))
        if least >= MIN_COMMON_TRACKS and float(across.sum()) < MAX_CUT_SURVIVAL * least:
            return SceneCut(frame, float(across.sum()) / least)
        both = film.seen[frame - 1] & film.seen[frame]
        steps.append((film.x[frame] - film.x[frame - 1])[both].norm(dim=-1) / film.pixel)
    usual = [float(step.median()) for step in steps if len(step)]
    if len(usual) > 2:
        typical = max(float(torch.tensor(usual, dtype=torch.float32).median()), 1.0)
        for frame, step in enumerate(steps, start=1):
            if len(step) and float((step > MIN_JUMP * typical).double().mean()) > MIN_JUMPING_SHARE:
                return SceneCut(frame, 1.0, float(step.median()) / typical)
    return None
