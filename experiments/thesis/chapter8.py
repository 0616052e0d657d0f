"""Chapter 8 of the thesis, checked: points and lines that move, measured by 3D sensors that move."""

from __future__ import annotations

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.extensors import compound, levi_civita, plucker
from experiments.thesis.definitions import (
    apart,
    collineations,
    homogeneous,
    inhomogeneous,
    mapped,
    matrix_rank,
    normal,
    on_lines,
    products,
    rank,
    rotation,
    seeded,
    uniform,
)
from experiments.thesis.statements import Chapter, Finding

CHAPTER = Chapter(8, "3D to 3D alignment")
JOIN, MINIMAL, VELOCITY, LINES = dyn.JoinTensor, dyn.MinimalJoinTensor, dyn.ConstantVelocityTensor, dyn.TranslatingLinesMatrix
EXACT = 1e-6


def scene(points: Tensor, draw: torch.Generator) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """Three measurements of points ``(3, n, 3)`` by a sensor that moves, and the collineations A, B to the first."""
    A, B = collineations(2, 3, draw)
    return (points[0], mapped(points[1], torch.linalg.inv(A)), mapped(points[2], torch.linalg.inv(B))), A, B


@CHAPTER.states("8, p. 99", "five matches of static points are sufficient for a collineation; a rigid motion follows from an SVD")
def classic() -> Finding:
    draw = seeded(0)
    A, x2 = collineations(1, 3, draw)[0], normal(5, 3, draw=draw)
    found = apart(dyn.fit(dyn.Collineation(3), mapped(x2, A), x2).tensor, A)
    R, t = rotation(uniform(3, draw=draw)), normal(3, draw=draw)
    still, go = normal(4, 3, draw=draw), on_lines(20, 3, 3, draw)
    P = [torch.cat([still, go[k]]) for k in range(3)]
    measured = [P[0], (P[1] - t) @ R, P[2]]
    rigid = dyn.align_points(*measured, model="rigid", threshold=1e-6).A
    truth = torch.cat([torch.cat([R, t[:, None]], 1), torch.tensor([[0, 0, 0, 1]], dtype=torch.float64)])
    error = apart(rigid, truth)
    return Finding(
        max(found, error) < EXACT, f"collineation {found:.0e}; rigid motion from 4 static among 20 moving points {error:.0e}"
    )


@CHAPTER.states("8.1, p. 102", "eq. 8.2: every vector V gives a Jtensor, and they span 4 dimensions")
def equation() -> Finding:
    draw = seeded(1)
    A, B = collineations(2, 3, draw)
    V = normal(8, 4, draw=draw)
    J = torch.einsum("ilmu,lj,mk,vu->vijk", levi_civita(4).double(), A, B, V)
    basis = JOIN.compose(A, B).flatten(1)
    left = J.flatten(1) - J.flatten(1) @ torch.linalg.pinv(basis) @ basis
    return Finding(
        rank(J.flatten(1)) == 4 and float(left.abs().max()) < EXACT,
        f"8 vectors: rank {rank(J.flatten(1))}, in the span of ours to {left.abs().max():.0e}",
    )


@CHAPTER.states("8.1, p. 101", "det[X, Y, Z, T] = t_i x_j y_k z_l eps_ijkl", "with the sign changed: t moves past three columns")
def determinant() -> Finding:
    vectors = normal(4, 4, draw=seeded(2))
    x, y, z, t = vectors
    printed = torch.einsum("i,j,k,l,ijkl->", t, x, y, z, levi_civita(4).double())
    value = torch.linalg.det(vectors.mT)
    return Finding(bool((printed - value).abs() < EXACT), f"determinant {value:.3f}, as printed {printed:.3f}")


@CHAPTER.states("8.1, p. 102", "60 matches leave a 4-dimensional null space")
def sixty() -> Finding:
    draw = seeded(3)
    views, A, B = scene(on_lines(60, 3, 3, draw), draw)
    found = dyn.fit(JOIN, *views).check()
    error = max(apart(mine, true) for mine, true in zip(JOIN.decompose(found.tensor), (A, B), strict=True))
    more = matrix_rank(scene(on_lines(100, 3, 3, draw), draw)[0])
    return Finding(more == 60 and error < EXACT, f"rank of 100 matches {more} of 64; A, B from 60 to {error:.0e}")


@CHAPTER.states("8.1, p. 103", "static points span 20 dimensions; a line adds four static and four other constraints")
def static() -> Finding:
    draw = seeded(4)
    still = matrix_rank(scene(on_lines(60, 3, 3, draw, static=60), draw)[0])
    line = normal(3, draw=draw) + normal(3, 20, 1, draw=draw) * normal(3, draw=draw)
    one, fixed = matrix_rank(scene(line, draw)[0]), matrix_rank(scene(line[:1].expand(3, -1, -1), draw)[0])
    return Finding((still, one, fixed) == (20, 8, 4), f"60 static points: rank {still}; one line: {one}, its static points {fixed}")


@CHAPTER.states("8.1, p. 103", "60 moving points lie on at least 10 lines, 5 of which hold up to 8 of them and 5 up to 4")
def ten_lines() -> Finding:
    def of(counts: list[int]) -> int:
        draw = seeded(5)
        points = torch.cat([normal(3, draw=draw) + normal(3, n, 1, draw=draw) * normal(3, draw=draw) for n in counts], 1)
        return matrix_rank(scene(points, draw)[0])

    ranks = of([8] * 5 + [4] * 5), of([8] * 9)
    return Finding(ranks[0] == 60 and ranks[1] < 60, f"5 x 8 + 5 x 4: rank {ranks[0]}; 9 lines of 8: {ranks[1]}")


@CHAPTER.states(
    "8.1, p. 103 (iv)", "unsegmented: at least 40 must move; labelled static points: 0 + 60, 1 + 50, ... 5 + 10, 6 + 4, 7 + 0"
)
def labelled() -> Finding:
    draw = seeded(6)
    ranks = [matrix_rank(scene(on_lines(still + go, 3, 3, draw, static=still), draw)[0]) for still, go in ((60, 39), (60, 40))]
    said = []
    for still, go in ((0, 60), (1, 50), (3, 30), (5, 10), (6, 4), (7, 0)):
        views, A, _ = scene(on_lines(still + go, 3, 3, draw, static=still), draw)
        found = dyn.fit(JOIN, *views, static=torch.arange(still + go) < still)
        said.append(found.status == dyn.Status.OK and apart(JOIN.decompose(found.tensor)[0], A) < EXACT)
    return Finding(
        ranks == [59, 60] and all(said), f"60 static + 39 or 40 moving: rank {ranks}; labelled: {sum(map(bool, said))} of 6 exact"
    )


@CHAPTER.states(
    "8.1, p. 103 (i-iii)", "slices give A and B; the tensors map points without A and B, and tell static points from moving ones"
)
def uses() -> Finding:
    draw = seeded(7)
    views, A, _ = scene(on_lines(100, 3, 3, draw, static=50), draw)
    tensor = dyn.fit(JOIN, *views).check().tensor
    direct = float((JOIN.transfer(tensor, views[0][:50], 1, 3) - views[2][:50]).norm(dim=-1).max())
    distance = JOIN.static_distance(tensor, *views)
    holds = direct < EXACT and float(distance[:50].max()) < EXACT < float(distance[50:].min())
    told = f"static {distance[:50].max():.0e}, moving {distance[50:].min():.0e}"
    return Finding(holds, f"A to {apart(JOIN.decompose(tensor)[0], A):.0e}; view 1 to 3 {direct:.0e}; {told}")


def minimal_scene(draw: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A, B, a camera M and the minimal Jtensor by eq. 8.4."""
    A, B = collineations(2, 3, draw)
    M = normal(3, 4, draw=draw)
    back = M @ torch.linalg.inv(B)
    return A, B, M, torch.einsum("lmk,li,mj->ijk", levi_civita(3).double(), back, back @ A)


@CHAPTER.states("8.2, p. 104", "eq. 8.3 and eq. 8.4 give the same minimal Jtensor")
def two_equations() -> Finding:
    A, B, M, second = minimal_scene(seeded(8))
    C = torch.linalg.svd(M).Vh[-1]
    first = torch.einsum("ilmu,lj,mk,u->ijk", levi_civita(4).double(), A, B @ torch.linalg.pinv(M), B @ C)
    ours = MINIMAL(M[None]).compose(A, B)[0]
    errors = apart(first, second), apart(ours, second)
    return Finding(max(errors) < EXACT, f"each other {errors[0]:.0e}, ours {errors[1]:.0e}")


@CHAPTER.states("8.2, p. 104", "3 x 4^2 - 1 = 47 measurements, for a camera that is arbitrary")
def fortyseven() -> Finding:
    draw = seeded(9)
    views, A, B = scene(on_lines(60, 3, 3, draw), draw)
    M = normal(3, 4, draw=draw)
    found = rank(products(homogeneous(views[0]), homogeneous(views[1]), homogeneous(views[2]) @ M.mT))
    fit = dyn.fit(MINIMAL, *(view[:47] for view in views)).check()
    error = max(apart(mine, true) for mine, true in zip(MINIMAL().decompose(fit.tensor), (A, B), strict=True))
    return Finding(found == 47 and error < EXACT, f"rank of 60 matches {found} of 48; A, B from 47 to {error:.0e}")


@CHAPTER.states(
    "8.2, p. 104",
    "A' S + S' A = 0 for the slices S gives 10 equations each, which recover A",
    "one Jtensor's equations have rank 11 of 16; a second camera is needed",
)
def slices() -> Finding:
    A, B, _, first = minimal_scene(seeded(10))
    back = normal(3, 4, draw=seeded(11)) @ torch.linalg.inv(B)
    second = torch.einsum("lmk,li,mj->ijk", levi_civita(3).double(), back, back @ A)

    def equations(N: Tensor) -> Tensor:
        units = torch.eye(16, dtype=torch.float64).reshape(16, 4, 4)
        # (A p')^i p'^j N_ijk = 0 for all p': the symmetric part of A' N_k
        parts = [(units.mT @ N[:, :, k]) + (units.mT @ N[:, :, k]).mT for k in range(3)]
        return torch.stack(parts, 1).flatten(1).mT

    alone, both = (
        int(torch.linalg.matrix_rank(m, rtol=1e-10)) for m in (equations(first), torch.cat([equations(first), equations(second)]))
    )
    left = float((equations(first) @ A.flatten()).abs().max())
    return Finding(alone == 15, f"A solves them to {left:.0e}; rank {alone} from one camera, {both} from two")


def moving(n: int, draw: torch.Generator, kind: str = "space") -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """Three measurements of points of constant velocities, the points and the velocities."""
    X, v = 2 * uniform(n, 3, draw=draw), 0.5 * normal(n, 3, draw=draw)
    if kind in ("plane", "line"):
        v[:, 2] = 0
    if kind == "line":
        v[:, 1] = 0
    if kind == "common":
        v = v[:1].expand(n, 3)
    return tuple(mapped(X + t * v, A) for t, A in enumerate(collineations(3, 3, draw))), X, v


def velocity_rows(views: tuple[Tensor, ...], draw: torch.Generator) -> Tensor:
    """P0, P1 and any plane through P2: three rows a match."""
    p = [homogeneous(view) for view in views]
    planes = torch.linalg.svd(p[2][:, None]).Vh[:, 1:]
    return torch.cat([products(p[0], p[1], planes[:, k]) for k in range(3)])


@CHAPTER.states("8.3, p. 105", "a tensor of 4^3 entries takes 21 matches of points of constant velocity across 3 views")
def velocity() -> Finding:
    draw = seeded(12)
    views, X, _ = moving(21, draw)
    found = rank(velocity_rows(views, draw))
    motion = VELOCITY.decompose(dyn.fit(VELOCITY, *views).check().tensor)
    y = VELOCITY.positions(motion, *views)
    second = float((y[:, 0] - 2 * y[:, 1] + y[:, 2]).abs().max() / y.std())
    affine = float((homogeneous(X) @ torch.linalg.lstsq(homogeneous(X), y[:, 0]).solution - y[:, 0]).abs().max() / y.std())
    return Finding(
        found == 63 and max(second, affine) < EXACT,
        f"rank {found} of 64; constant velocity to {second:.0e}, affine to {affine:.0e}",
    )


@CHAPTER.states(
    "8.3, p. 105",
    "21 matches, whatever the velocities (nothing is said of them)",
    "they must span space: in a plane rank 58, along a line 49, a common one 36",
)
def special_velocities() -> Finding:
    ranks = [rank(velocity_rows(moving(80, seeded(13), kind)[0], seeded(14))) for kind in ("plane", "line", "common")]
    return Finding(ranks == [63, 63, 63], f"ranks {ranks} of 63")


@CHAPTER.states(
    "8.3, p. 105",
    "the 7 x 7 determinant is multilinear in the measurements P0, P1, L2",
    "it is quadratic more: it vanishes where P0's last entry does",
)
def seven() -> Finding:
    draw = seeded(15)
    A = [torch.cat([a, t * a[:, :3]], 1) for t, a in enumerate(collineations(3, 3, draw))]

    def value(p0: Tensor, p1: Tensor, plane: Tensor) -> Tensor:
        rows = [torch.cat([p[3] * torch.eye(3, dtype=torch.float64), -p[:3, None]], 1) @ a for p, a in ((p0, A[0]), (p1, A[1]))]
        return torch.linalg.det(torch.cat([*rows, (plane @ A[2])[None]]))

    p0, q0, p1, plane = normal(4, draw=draw), normal(4, draw=draw), normal(4, draw=draw), normal(4, draw=draw)
    linear = float((value(p0 + q0, p1, plane) - value(p0, p1, plane) - value(q0, p1, plane)).abs())
    p0[3] = 0
    return Finding(
        linear < EXACT,
        f"additivity in P0 fails by {linear:.0e}; value where P0's last entry is 0: {value(p0, p1, plane).abs():.0e}",
    )


@CHAPTER.states("8.3, p. 106", "a camera in the third view: 3 x 4^2 entries and 24 matches")
def camera() -> Finding:
    draw = seeded(16)
    X, v = 2 * uniform(24, 3, draw=draw), 0.5 * normal(24, 3, draw=draw)
    A = collineations(3, 3, draw)
    M = normal(3, 4, draw=draw)
    p = [homogeneous(mapped(X, A[0])), homogeneous(mapped(X + v, A[1])), homogeneous(X + 2 * v) @ M.mT]
    lines = torch.linalg.svd(p[2][:, None]).Vh[:, 1:]
    ranks = [rank(torch.cat([products(p[0][:n], p[1][:n], lines[:n, k]) for k in range(2)])) for n in (23, 24)]
    return Finding(ranks[1] == 47 and ranks[0] < 47, f"rank from 23 matches {ranks[0]}, from 24 {ranks[1]} of 48")


@CHAPTER.states(
    "8.3, p. 106",
    "the reconstruction is first in P^7, then in P^3; 8.3.1: projections from P^6 to P^2",
    "P^6 and P^3: seven coordinates, 4 x 7 matrices",
)
def spaces() -> Finding:
    matrix = torch.cat([collineations(1, 3, seeded(17))[0], collineations(1, 3, seeded(17))[0][:, :3]], 1)
    return Finding(
        tuple(matrix.shape) == (4, 8), f"the projections of points of constant velocity are {matrix.shape[0]} x {matrix.shape[1]}"
    )


@CHAPTER.states("8.3.1, p. 106", "P0^i P1^j A_ij^k is the point in the third view (point transfer)")
def transfer() -> Finding:
    views, _, _ = moving(40, seeded(18))
    tensor = dyn.fit(VELOCITY, *views).check().tensor
    error = float((VELOCITY.transfer(tensor, *views[:2]) - views[2]).norm(dim=-1).max())
    contracted = torch.einsum("ijk,ni,nj->nk", tensor, homogeneous(views[0]), homogeneous(views[1]))
    own = float((inhomogeneous(contracted) - views[2]).norm(dim=-1).max())
    return Finding(max(error, own) < EXACT, f"40 points: {error:.0e}, by the contraction itself {own:.0e}")


@CHAPTER.states("8.3, p. 106", "velocities are known up to a common one; one static point resolves it")
def gauge() -> Finding:
    draw = seeded(19)
    X, v = 2 * uniform(40, 3, draw=draw), 0.5 * normal(40, 3, draw=draw)
    v[0] = 0
    views = tuple(mapped(X + t * v, A) for t, A in enumerate(collineations(3, 3, draw)))
    motion = VELOCITY.decompose(dyn.fit(VELOCITY, *views).check().tensor)
    errors = []
    for fixed in (motion, VELOCITY.fix_gauge(motion, *views, weights=(torch.arange(40) == 0).double())):
        y = VELOCITY.positions(fixed, *views)
        to = torch.linalg.lstsq(homogeneous(X), y[:, 0]).solution
        left = (y[:, 1] - y[:, 0]) - v @ to[:3]
        errors += [float((left - left.mean(0)).abs().max() / y.std()), float(left.abs().max() / y.std())]
    return Finding(
        errors[0] < EXACT and errors[3] < EXACT, f"up to a common velocity {errors[0]:.0e}; with the static point {errors[3]:.0e}"
    )


def moved_lines(n: int, draw: torch.Generator, objects: int = 0, turning: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """Lines as two points before and after each moved by itself, and A; with ``objects`` they are on so many translating bodies,
    with ``turning`` the two points of a line move in one direction by different amounts."""
    A = collineations(1, 3, draw)[0]
    ends = 2 * uniform(n, 2, 3, draw=draw)
    shift = normal(objects or n, 1, 3, draw=draw)[torch.arange(n) % (objects or n)]
    after = ends + (1 + uniform(n, 2, 1, draw=draw) if turning else 1) * shift
    return ends, mapped(after, torch.linalg.inv(A)), A


def line_rows(first: Tensor, second: Tensor) -> Tensor:
    """Of the estimation matrix of l2' A' J l1 = 0."""
    return products(plucker(first), plucker(second))


@CHAPTER.states(
    "8.4, p. 108", "the rows of the collineation of lines are the Pluecker coordinates of pairs of rows of that of points"
)
def lines_map() -> Finding:
    _, second, A = moved_lines(10, seeded(20))
    mapped_lines = plucker(second) @ compound(A, 2).mT
    direct = plucker(mapped(second, A))
    error = max(apart(a, b) for a, b in zip(mapped_lines, direct, strict=True))
    return Finding(error < EXACT, f"10 lines: {error:.0e}")


@CHAPTER.states("8.4, p. 109", "35 line matches between two views determine the matrix, and it the collineation")
def lines() -> Finding:
    first, second, A = moved_lines(35, seeded(21), turning=True)
    found = dyn.fit(LINES, first, second).check()
    error = apart(LINES.decompose(found.tensor), A)
    return Finding(
        rank(line_rows(first, second)) == 35 and error < EXACT, f"rank {rank(line_rows(first, second))}; A to {error:.0e}"
    )


@CHAPTER.states(
    "8.4, p. 109",
    "experiments show that two objects are sufficient to solve linearly",
    "two translating objects have rank 28; 31 takes three",
)
def objects() -> Finding:
    ranks = [rank(line_rows(*moved_lines(80, seeded(22), objects=count)[:2])) for count in (1, 2, 3)]
    return Finding(ranks[1] == 35, f"1, 2, 3 objects: rank {ranks}")


@CHAPTER.states("8.4, p. 109", "lines in pure translation reduce the rank to 31 instead of 35")
def pure() -> Finding:
    found = rank(line_rows(*moved_lines(80, seeded(23))[:2]))
    return Finding(found == 31, f"80 lines: rank {found}")


@CHAPTER.states("8.4, p. 109", "the ambiguity is a common translation and a scale")
def ambiguity() -> Finding:
    draw = seeded(24)
    A = torch.eye(4, dtype=torch.float64)
    A[:3] *= 1.7
    A[:3, 3] = normal(3, draw=draw)
    plain, _, _ = moved_lines(40, seeded(25))
    after = plain + normal(40, 1, 3, draw=draw)
    values = []
    for change in (torch.eye(4, dtype=torch.float64), A):
        before, moved = homogeneous(plain), homogeneous(mapped(after, change))
        values.append(float(torch.linalg.det(torch.cat([before, moved], 1)).abs().max()))
    return Finding(
        max(values) < EXACT, f"incidence of 40 lines before {values[0]:.0e}, after a scale of 1.7 and a translation {values[1]:.0e}"
    )


@CHAPTER.states("8.4, p. 109", "two static points overcome the ambiguity")
def repaired() -> Finding:
    said, holds = [], True
    for count in (0, 2):
        draw = seeded(26)
        first, second, A = moved_lines(80, draw, objects=count)
        X = 2 * uniform(2, 3, draw=draw)
        found = dyn.align_lines(first, second, static_points=(X, mapped(X, torch.linalg.inv(A))), threshold=1e-6)
        error = apart(found.A, A)
        holds &= bool(found.status == dyn.Status.OK) and error < EXACT
        said.append(f"{count or 80} objects: A to {error:.0e}")
    return Finding(holds, "; ".join(said))
