"""What ``reconstruct`` returns: cameras, points and velocities of a moving scene, and what should be known about them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.core.solution import Status, failed
from dyntorch.geometry.homogeneous import inhomogeneous
from dyntorch.geometry.triangulation import reproject
from dyntorch.tasks.outcome import Notice, check_results
from dyntorch.tasks.reconstruct.motions import Motion


class Ranked(NamedTuple):
    """How one model did when the model was to be chosen."""

    motion: str
    score: float
    """Penalized cost, less is better; infinite where the model failed or was not tried."""
    residual: float
    """Rms reprojection error in the unit of the tracks; NaN where there is none."""
    reason: str = ""
    """Why it was not tried; empty where it was."""


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction:
    """Result of :func:`dyntorch.reconstruct`.

    Attributes:
        motion: the model.
        cameras: :math:`P_i`, ``(*batch, views, l + 1, d + 1)`` of norm 1, :math:`x_i \\sim P_i X(t_i)`; zero where the status says
            that there are none.  Of two bodies: those of body 1.
        points: ``(*batch, n, d)`` positions at time 0; NaN where a point was not found.  Of two bodies: each in the frame of its
            own body.
        velocities: ``(*batch, n, d)`` per unit of the times, at time 0; None for two bodies.
        labels: ``(*batch, n)`` 0 outlier or not found, 1 static (known only where static points were given), 2 moving; of two
            bodies 1 and 2.  All 0 where the status is neither OK nor AMBIGUOUS.
        residual: ``(*batch,)`` rms reprojection error of the observations that count, in the unit of the tracks.
        residuals: ``(*batch, views, n)`` reprojection distances; NaN where missing or not found.
        sigma: ``(*batch,)`` noise of one coordinate that the residuals show.
        status: ``(*batch,)`` of :class:`dyntorch.Status`.
        structure: ``(*batch, n, K)`` homogeneous constants Y of the model, :math:`X(t) \\sim B(t)\\,Y`.
        projections: ``(*batch, views, l + 1, K)``, :math:`M_i \\sim P_i B_i`.
        inliers: ``(*batch, views, n)`` observations that count.
        times: ``(views,)``.
        ambiguity: a sentence: what the tracks cannot tell, even without noise.
        warnings: notices on single problems of the batch.
        bodies: cameras of both bodies, ``(*batch, 2, views, l + 1, d + 1)``; None without.
        candidates: where the model was to be chosen, the models that were tried, best first, and those that could not be, with the
            reason.
    """

    motion: Motion
    cameras: Tensor
    points: Tensor
    velocities: Tensor | None
    labels: Tensor
    residual: Tensor
    residuals: Tensor
    sigma: Tensor
    status: Tensor
    structure: Tensor
    projections: Tensor
    inliers: Tensor
    times: Tensor
    ambiguity: str
    warnings: tuple[Notice, ...] = ()
    bodies: Tensor | None = None
    candidates: tuple[Ranked, ...] = field(default=())

    def at(self, time: float) -> Tensor:
        """Positions ``(*batch, n, d)`` at any time; of two bodies the points, which rest in their frames.

        Example:
            >>> import torch, dyntorch as dyn
            >>> from dyntorch import scenes
            >>> scene = scenes.lifted("constant_velocity_2d", 30, generator=torch.Generator().manual_seed(0))
            >>> found = dyn.reconstruct(scene.tracks, "constant_velocity_2d")
            >>> bool(torch.allclose(found.at(2.0), found.points + 2 * found.velocities))
            True
        """
        if self.motion.lift is None:
            return self.points
        lift = self.motion.lifts([time])[0].to(self.structure)
        return torch.where(self.points.isnan(), self.points, inhomogeneous(self.structure @ lift.mT))

    def image(self, camera: Tensor, time: float) -> Tensor:
        """Where a camera ``(*batch, l + 1, d + 1)`` sees the points at any time, ``(*batch, n, l)``: views that nobody took."""
        if self.motion.lift is None:
            raise ValueError(f"{self.motion!r} says nothing about times between the views")
        lift = self.motion.lifts([time])[0].to(self.structure)
        seen = reproject((camera @ lift).unsqueeze(-3), self.structure).squeeze(-3)
        return torch.where(self.points.isnan().any(-1, keepdim=True), torch.nan, seen)

    def check(self) -> Reconstruction:
        """Raise where any problem failed.

        Raises:
            ValueError: says which problems failed, how, and what to do.
        """
        check_results(self.motion.name, self.status, self.warnings)
        return self

    def __repr__(self) -> str:
        states = Counter(Status(s).name for s in self.status.reshape(-1).tolist())
        views, n = self.residuals.shape[-2:]
        listed = ", ".join(f"{count} {name}" for name, count in states.items()) or "empty"
        lines = [f"Reconstruction({self.motion.name}, views={views}, points={n}, batch={tuple(self.status.shape)}: {listed})"]
        good = ~failed(self.status)
        if bool(good.any()):
            kinds = ("outlier", "body 1", "body 2") if self.motion.bodies > 1 else ("outlier", "static", "moving")
            kinds = ("outlier", "static", "static") if self.motion.static else kinds
            count = Counter(kinds[int(label)] for label in self.labels[good].flatten().tolist())
            lines.append("  labels: " + ", ".join(f"{count[kind]} {kind}" for kind in dict.fromkeys(kinds) if count[kind]))
            middle = float(self.residual[good].double().median())
            lines.append(f"  residual: {middle:.3g} rms" + (" (median)" if self.status.ndim else ""))
        if self.candidates:
            best = self.candidates[0].score
            tried = [c for c in self.candidates[1:] if not c.reason]
            others = ", ".join(f"{c.motion} (+{c.score - best:.0f})" for c in tried[:3])
            lines.append(f"  chosen by a penalized cost of {best:.0f}; then {others or 'no other'}")
            lines += [f"  not tried: {c.motion} ({c.reason})" for c in self.candidates if c.reason]
        if self.ambiguity:
            lines.append(f"  {self.ambiguity}")
        if self.status.ndim:
            seen = Counter(code for code, _ in {(w.code.value, w.problem) for w in self.warnings})
            lines += [f"  warning {code}: {count} of {self.status.numel()} problems" for code, count in sorted(seen.items())]
        else:
            lines += [f"  warning {w}" for w in self.warnings]
        return "\n".join(lines)
