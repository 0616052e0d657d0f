"""Tracks of a video from a car: a street that stands still, and cars that drive in their own ways, seen as a tracker sees them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import apply, homogeneous
from dyntorch.scenes.traffic import CAR, ROAD, Boxes, Chance, Drive, Kind, driven, drives, rotations, street_walls

SIZE, FOCAL, PRINCIPAL = (1242, 375), 721.0, (609.5, 172.8)
"""Of the rectified pictures of KITTI, pixels (Geiger, Lenz, Stiller and Urtasun, IJRR 2013)."""
NEAREST = 2.0
"""Metres: what is nearer is not tracked."""
GROUND, NOTHING = -1, -2
ATTEMPTS = 200
"""Draws of a scene until every car is seen and told apart by someone who knows the geometry."""
ALONG = 8
"""Draws of points until a body that is seen has its number of tracks."""


CAR_TRACK_SHARE = (0.035, 0.25)  # share of the tracks that one car has, from and to
MAX_DENSITY = 25.0  # tracks that a car has at most per 1000 square pixels where it is largest, of 500 in all
FIRST_FRAME_SHARE = 0.65  # share of the tracks that begin in frame 0, in 20 frames; less in more
MIN_TRACK_FRAMES = 5  # frames of a track
MAX_STEP = 70.0  # pixels per frame that the tracker follows
TRACK_DRIFT = 0.15  # of a track, per frame, in units of sigma
BLUR_DRIFT = 0.01  # further drift per frame and pixel of motion, in units of sigma


@dataclass(frozen=True)
class StreetOptions:
    """What kind of street it is; the defaults resemble the clips of KITTI that KT3DMoSeg took.

    Attributes:
        speed: of the camera, from and to, metres per frame (10 per second: .85 is 31 km/h); 0 stands.
        steering: largest turn of the camera within its lane, radians per frame.
        turn: of the camera at the junction, from and to, radians per frame, to the left or right.
        pitch: of the camera on uneven road, radians, standard deviation.
        junction: from and to, metres ahead of the camera at half time.
        traffic: what the cars may do.
        buses: share of cars that are 11 m long and 3 m high.
        texture: share of the surface that has something to track, in patches of 1.5 m.
        road: of what is tracked elsewhere, the share that is tracked on the road.
        members: least tracks of a car.
        visible: pixels per frame by which the corners of a car move otherwise (median) than on every other body, at its best.
        loss: share of the tracks that the tracker loses per frame, besides those that leave or are hidden.
    """

    speed: tuple[float, float] = (0.5, 1.2)
    steering: float = 0.008
    turn: tuple[float, float] = (0.0, 0.01)
    pitch: float = 0.002
    junction: tuple[float, float] = (10.0, 26.0)
    traffic: tuple[Kind, ...] = ("slower", "faster", "equal", "oncoming", "crossing", "turning")
    buses: float = 0.0
    texture: float = 0.6
    road: float = 0.3
    members: int = 15
    visible: float = 1.0
    loss: float = 0.04


DAY = StreetOptions()


@dataclass(frozen=True)
class Street:
    """Tracks of a video and the truth.

    Attributes:
        tracks: ``(frames, n, 2)`` px, x right, y down, NaN where missing.
        labels: ``(n,)`` 0 outlier, 1 the street, 2.. the cars.
        cameras: ``(frames, 3, 4)`` projections, metres of the world to pixels.
        K: ``(3, 3)`` calibration.
        size: of the picture, pixels.
        exact: ``(frames, n, 2)`` px without noise and outliers, NaN where missing.
        points: ``(frames, n, 3)`` metres: the world is the frame of a level camera at the first frame's heading.
        motions: ``(frames, bodies, 3, 4)`` take the points of a body from frame 0 to every frame, metres.
        kinds: what the cars do, in the order of their labels from 2.
    """

    tracks: Tensor
    labels: Tensor
    cameras: Tensor
    K: Tensor
    size: tuple[int, int]
    exact: Tensor
    points: Tensor
    motions: Tensor
    kinds: tuple[Kind, ...]


def streets(
    bodies: int = 3,
    frames: int = 20,
    tracks: int = 500,
    sigma: float = 0.5,
    outliers: float = 0.0,
    *,
    options: StreetOptions = DAY,
    generator: torch.Generator | None = None,
) -> Street:
    r"""What a camera in a moving car sees, 10 frames per second: :math:`x_{it} \sim K [R_t | t_t] M_{b(i)t} X_i` plus noise.

    The street: road, houses, parked cars, poles, trees and a few points far away.  The cars, 4 x 1.7 x 1.5 m, stand on the road:
    ahead in the camera's direction (their points move along the camera's epipolar lines), oncoming, crossing or turning at a
    junction.  Tracks begin and end: points leave the picture, are hidden by what is nearer, or are lost.

    Args:
        bodies: the street and ``bodies - 1`` cars.
        frames: of the video.
        tracks: their number n, in random order.
        sigma: noise, pixels; a track drifts besides by a share of it.
        outliers: share of the tracks that follow nothing.
        options: the kind of street and of tracker.
        generator: source of all randomness.

    Raises:
        ValueError: numbers out of range, too few tracks for the bodies, or no scene in which all cars are seen: the remedy is
            fewer bodies or wider options.

    Example:
        >>> import torch
        >>> street = streets(3, generator=torch.Generator().manual_seed(0))
        >>> tuple(street.tracks.shape), street.labels.unique().tolist(), tuple(street.cameras.shape)
        ((20, 500, 2), [1, 2, 3], (20, 3, 4))
        >>> seen = apply(street.cameras, street.points)
        >>> bool(((seen - street.exact).norm(dim=-1).nan_to_num() < 1e-6).all())
        True
    """
    _check(bodies, frames, tracks, sigma, outliers, options)
    chance = Chance(generator)
    for _ in range(ATTEMPTS):
        scene = _Scene.draw(bodies, frames, options, chance)
        quota = scene.quota(tracks, chance) if scene is not None else None
        if scene is None or quota is None:
            continue
        found = [scene.sample(body, count, chance) for body, count in enumerate(quota)]
        if all(part is not None for part in found):
            return scene.street([part for part in found if part is not None], sigma, outliers, chance)
    raise ValueError(
        f"no street with bodies={bodies}, frames={frames} and these options was found in {ATTEMPTS} attempts: a car is hardly seen "
        f"or moves like another one; give fewer bodies, more frames, or more kinds of traffic"
    )


def _check(bodies: int, frames: int, tracks: int, sigma: float, outliers: float, options: StreetOptions) -> None:
    if bodies < 1 or frames < MIN_TRACK_FRAMES:
        raise ValueError(f"a street needs bodies >= 1 and frames >= {MIN_TRACK_FRAMES}, got bodies={bodies}, frames={frames}")
    if tracks < 2 * options.members * bodies:
        raise ValueError(f"{bodies} bodies need at least {2 * options.members * bodies} tracks, got tracks={tracks}")
    if not sigma >= 0:
        raise ValueError(f"sigma must be >= 0, got {sigma}")
    if not 0 <= outliers <= 1:
        raise ValueError(f"outliers is a share from 0 to 1, got {outliers}")
    unknown = set(options.traffic) - set(get_args(Kind))
    if unknown or not options.traffic:
        raise ValueError(f"traffic must name some of {', '.join(get_args(Kind))}, got {options.traffic}")


@dataclass(frozen=True)
class _Part:
    """Tracks of one body: which of ``alive (frames, m)`` the tracker has, at ``points (frames, m, 3)``, seen at ``image``."""

    alive: Tensor
    points: Tensor
    image: Tensor


@dataclass(frozen=True)
class _Scene:
    """Cameras ``(frames, 3, 4)`` with their centres ``(frames, 3)``, boxes that stand and cars that drive."""

    options: StreetOptions
    K: Tensor
    cameras: Tensor
    centres: Tensor
    boxes: Boxes
    cars: list[Drive]
    patches: Tensor

    @staticmethod
    def draw(bodies: int, frames: int, options: StreetOptions, chance: Chance) -> _Scene | None:
        """A scene, or nothing where a car cannot be told from another body."""
        K = torch.tensor([[FOCAL, 0, PRINCIPAL[0]], [0, FOCAL, PRINCIPAL[1]], [0, 0, 1]], dtype=torch.float64)
        own = _driven(frames, options, chance)
        centres, rotations = _looking(own, options, chance)
        cameras = K @ torch.cat([rotations, -rotations @ centres[..., None]], dim=-1)
        half = own.place[frames // 2]
        junction = float(half[2]) + chance.between(*options.junction)
        cars = drives(bodies - 1, own, junction, options.traffic, options.buses, chance)
        if cars is None:
            return None
        walls = street_walls(own, cars, junction, chance)
        scene = _Scene(options, K, cameras, centres, walls.with_cars(cars), cars, 10 * chance.uniform(3))
        return scene if scene.distinct() else None

    def distinct(self) -> bool:
        """Whether every car moves visibly otherwise than every other body, somewhere in the clip."""
        still = torch.eye(3, 4, dtype=torch.float64).expand(len(self.cameras), 3, 4)
        motions = [car.motion() for car in self.cars]
        for k, car in enumerate(self.cars):
            now, after = car.corners()[:-1], car.corners()[1:]
            seen = self.inside(now, self.cameras[:-1]) & self.inside(after, self.cameras[1:])
            true = apply(self.cameras[1:], after)
            for motion in [still, *motions[:k], *motions[k + 1 :]]:
                turn = motion[1:, :, :3] @ motion[:-1, :, :3].mT
                shift = motion[1:, :, 3] - (turn @ motion[:-1, :, 3:])[..., 0]
                other = apply(self.cameras[1:], now @ turn.mT + shift[:, None])
                apart = torch.where(seen, (other - true).norm(dim=-1), torch.nan).nanmedian(dim=1).values
                if float(apart.nan_to_num().max()) < self.options.visible:
                    return False
        return True

    def inside(self, points: Tensor, cameras: Tensor) -> Tensor:
        """``(frames, m)`` whether the picture shows ``points (frames, m, 3)``, were nothing in between."""
        x = apply(cameras, points)
        depth = (homogeneous(points) @ cameras.mT)[..., 2]
        return (depth > NEAREST) & (x >= 0).all(-1) & (x[..., 0] <= SIZE[0] - 1) & (x[..., 1] <= SIZE[1] - 1)

    def frame_of(self, car: Drive) -> tuple[Tensor, Tensor, Tensor]:
        """Rectangles around a car, ``(frames, 2)`` low and high corners within the picture, and areas, 0 where it is not seen."""
        corners = car.corners()
        x = apply(self.cameras, corners)
        depth = (homogeneous(corners) @ self.cameras.mT)[..., 2]
        size = x.new_tensor([SIZE[0] - 1, SIZE[1] - 1])
        low, high = x.amin(1).clamp(min=0).minimum(size), x.amax(1).clamp(min=0).minimum(size)
        area = (high - low).prod(-1) * (depth.amin(1) > NEAREST)
        return low, high, area

    def quota(self, tracks: int, chance: Chance) -> list[int] | None:
        """Tracks of every body, the street first; nothing where a car is too small or the street has too little."""
        low, high = CAR_TRACK_SHARE
        counts = []
        for car in self.cars:
            share = math.exp(chance.between(math.log(low), math.log(high)))
            most = MAX_DENSITY / 1000 * float(self.frame_of(car)[2].max()) * max(1.0, tracks / 500)
            counts.append(int(min(max(self.options.members, share * tracks), most)))
        if any(count < self.options.members for count in counts):
            return None
        # more than 6 of 10 tracks are the cars' only where several are near
        part = min(1.0, 0.6 * tracks / max(sum(counts), 1))
        counts = [max(self.options.members, int(part * count)) for count in counts]
        return [tracks - sum(counts), *counts]

    def sample(self, body: int, count: int, chance: Chance) -> _Part | None:
        """Tracks of a body, 0 = the street, or nothing where the tracker finds too few."""
        found: list[_Part] = []
        for _ in range(ALONG):
            missing = count - sum(part.alive.shape[1] for part in found)
            if missing <= 0:
                break
            drawn = self._candidates(body, 4 * missing + 100, chance)
            if drawn is not None:
                found.append(_first(drawn, missing))
        if sum(part.alive.shape[1] for part in found) < count:
            return None
        return _Part(*(torch.cat([getattr(part, name) for part in found], 1) for name in ("alive", "points", "image")))

    def _candidates(self, body: int, count: int, chance: Chance) -> _Part | None:
        """Points that rays through random pixels of random frames meet first, followed until they are lost."""
        frames, options = len(self.cameras), self.options
        low, high = torch.zeros(frames, 2, dtype=torch.float64), torch.tensor([SIZE] * frames, dtype=torch.float64) - 1
        seen = torch.ones(frames, dtype=torch.bool)
        if body > 0:
            low, high, area = self.frame_of(self.cars[body - 1])
            seen = area > 60.0
        latest = frames - MIN_TRACK_FRAMES
        begin = torch.where(
            chance.uniform(count) < FIRST_FRAME_SHARE * min(1.0, 20 / frames), 0.0, chance.uniform(count) * (latest + 1)
        )
        start = begin.long().clamp(max=latest)
        start = start[seen[start]]
        pixel = low[start] + (high - low)[start] * chance.uniform(len(start), 2)
        ray = self._rays(start, pixel)
        depth, box = self.boxes.first_hit(start, self.centres[start], ray, GROUND, NOTHING)
        far = (box == NOTHING) & (pixel[:, 1] > PRINCIPAL[1] - 45)
        # what is far is on the road at most, not below it
        road = (ROAD - self.centres[start, 1]) / ray[:, 1].clamp(min=1e-9)
        depth = torch.where(far, (80 + 170 * chance.uniform(len(start))).minimum(road), depth)
        deeper = self.boxes.relief[box.clamp(min=0)] * chance.uniform(len(start)) * (box >= 0)
        point = self.centres[start] + ray * (depth + deeper / ray.norm(dim=-1))[:, None]
        point[:, 1].clamp_(max=ROAD)
        owner = torch.where(box >= 0, self.boxes.body[box.clamp(min=0)], 0)
        local = self.boxes.local(start, box.clamp(min=0), point)
        place = torch.where((box >= 0)[:, None], local, point)
        patch = ((place / 1.5).floor() @ self.patches).sin() * 1e4
        rough = (patch - patch.floor() < options.texture) | (body > 0)
        kept = (owner == body) & ((box != NOTHING) | far) & rough
        kept &= (box != GROUND) | (chance.uniform(len(start)) < options.road)
        return self._follow_tracks(start[kept], box[kept], local[kept], point[kept], chance) if bool(kept.any()) else None

    def _rays(self, frame: Tensor, pixel: Tensor) -> Tensor:
        """``(m, 3)`` directions of pixels, of depth 1."""
        return torch.linalg.solve(self.cameras[frame, :, :3], homogeneous(pixel)[..., None])[..., 0]

    def _follow_tracks(self, start: Tensor, box: Tensor, local: Tensor, point: Tensor, chance: Chance) -> _Part:
        """Tracks from their first frame until they leave, are hidden, move too far, or are lost."""
        frames = torch.arange(len(self.cameras))
        moved = torch.stack([self.boxes.world(t, box.clamp(min=0), local) for t in frames.tolist()])
        points = torch.where((box >= 0)[None, :, None], moved, point)
        image = apply(self.cameras, points)
        step = torch.nn.functional.pad(image.diff(dim=0).norm(dim=-1), (0, 0, 1, 0))
        after = frames[:, None] >= start
        life = (chance.uniform(len(start)).log() / math.log(1 - self.options.loss)).ceil() if self.options.loss > 0 else torch.inf
        lost = ~self.inside(points, self.cameras) | ((step > MAX_STEP) & (frames[:, None] > start))
        alive = after & ((after & lost).cumsum(0) == 0) & (frames[:, None] - start < MIN_TRACK_FRAMES + life)
        hidden = torch.zeros_like(alive)
        for t in frames.tolist():
            here = alive[t].nonzero()[:, 0]
            hidden[t, here] = ~self._free(t, points[t, here], box[here])
        alive &= hidden.cumsum(0) == 0
        long = alive.sum(0) >= MIN_TRACK_FRAMES
        return _Part(alive[:, long], points[:, long], image[:, long])

    def _free(self, frame: int, points: Tensor, own: Tensor) -> Tensor:
        """``(m,)`` whether nothing stands before the points of boxes ``own``."""
        ray = points - self.centres[frame]
        depth, box = self.boxes.first_hit(torch.full_like(own, frame), self.centres[frame].expand_as(ray), ray, GROUND, NOTHING)
        relief = torch.where(own >= 0, self.boxes.relief[own.clamp(min=0)], 0.0)
        allowed = (0.3 + 1.5 * relief) / ray.norm(dim=-1)
        return (depth > 1 - allowed) | ((box == own) & (own == GROUND))

    def street(self, parts: Sequence[_Part], sigma: float, outliers: float, chance: Chance) -> Street:
        """What the tracker reports, in random order."""
        alive, points, image = (torch.cat([getattr(part, name) for part in parts], 1) for name in ("alive", "points", "image"))
        sizes = torch.tensor([part.alive.shape[1] for part in parts])
        labels = torch.arange(1, len(parts) + 1).repeat_interleave(sizes)
        order = chance.uniform(len(labels)).argsort()
        alive, points, image, labels = alive[:, order], points[:, order], image[:, order], labels[order]
        exact = torch.where(alive[..., None], image, torch.nan)
        step = torch.nn.functional.pad(image.diff(dim=0).norm(dim=-1).clamp(max=MAX_STEP), (0, 0, 1, 0))
        drift = (chance.normal(*image.shape) * (TRACK_DRIFT + BLUR_DRIFT * step)[..., None]).cumsum(0)
        first = alive.double().argmax(0)
        drift = drift - drift[first, torch.arange(len(labels))]
        tracks = image + sigma * (chance.normal(*image.shape) + drift)
        wrong = chance.uniform(len(labels)).argsort() < round(outliers * len(labels))
        tracks = torch.where(wrong[:, None], _astray(image, first, alive, chance), tracks)
        kept = alive[..., None] & (~wrong[:, None] | (tracks >= 0) & (tracks <= tracks.new_tensor(SIZE) - 1)).all(-1, keepdim=True)
        return Street(
            tracks=torch.where(kept, tracks, torch.nan),
            labels=torch.where(wrong, 0, labels),
            cameras=self.cameras,
            K=self.K,
            size=SIZE,
            exact=exact,
            points=points,
            motions=torch.stack([torch.eye(3, 4).double().expand(len(alive), 3, 4), *(car.motion() for car in self.cars)], 1),
            kinds=tuple(car.kind for car in self.cars),
        )


def _driven(frames: int, options: StreetOptions, chance: Chance) -> Drive:
    """The way of the camera's car, from x = z = 0 on."""
    ramp = torch.linspace(-1, 1, frames, dtype=torch.float64)
    speed = chance.between(*options.speed) * (1 + ramp * chance.between(-0.15, 0.15))
    # within the lane: to and fro; at the junction: one way
    time = torch.arange(frames, dtype=torch.float64)
    sway = options.steering * chance.between(-1.0, 1.0) * (time * chance.between(0.1, 0.3) + chance.between(0.0, 6.28)).sin()
    turn = chance.sign() * chance.between(*options.turn)
    heading = torch.nn.functional.pad((sway + turn)[:-1].cumsum(0), (1, 0))
    return driven(speed, heading, "equal", CAR, (0.0, 0.0), 0)


def _looking(own: Drive, options: StreetOptions, chance: Chance) -> tuple[Tensor, Tensor]:
    """Centres ``(frames, 3)`` and rotations ``(frames, 3, 3)`` from the world to the camera, which nods on uneven road."""
    frames = len(own.place)
    time = torch.arange(frames, dtype=torch.float64)
    waves = [(time * chance.between(0.3, 1.2) + chance.between(0.0, 6.28)).sin() for _ in range(3)]
    pitch = options.pitch * (waves[0] + 0.5 * chance.normal(frames))
    roll = options.pitch * 0.5 * waves[1]
    centres = own.place - torch.tensor([0.0, ROAD, 0.0], dtype=torch.float64)
    centres[:, 1] += 5 * options.pitch * waves[2]
    zero, one = torch.zeros_like(time), torch.ones_like(time)
    nod = torch.stack([one, zero, zero, zero, pitch.cos(), -pitch.sin(), zero, pitch.sin(), pitch.cos()], -1).unflatten(-1, (3, 3))
    lean = torch.stack([roll.cos(), -roll.sin(), zero, roll.sin(), roll.cos(), zero, zero, zero, one], -1).unflatten(-1, (3, 3))
    return centres, lean @ nod @ rotations(own.heading).mT


def _first(part: _Part, count: int) -> _Part:
    return _Part(part.alive[:, :count], part.points[:, :count], part.image[:, :count])


def _astray(image: Tensor, first: Tensor, alive: Tensor, chance: Chance) -> Tensor:
    """Where a tracker goes that follows nothing: from the first place on, in a direction of its own, unsteadily."""
    frames, n, _ = image.shape
    step = torch.where(alive[1:, :, None] & alive[:-1, :, None], image.diff(dim=0), 0.0)
    length = 2 + step.norm(dim=-1).amax(0)[chance.uniform(n).argsort()]
    angle = 6.28 * chance.uniform(n) + 0.3 * chance.normal(frames, n)
    way = length[:, None] * torch.stack([angle.cos(), angle.sin()], -1) * chance.uniform(frames, n, 1)
    way = way.cumsum(0)
    own = torch.arange(n)
    return image[first, own] + way - way[first, own]
