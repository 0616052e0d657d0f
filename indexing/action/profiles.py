r"""What a clip of a known action says of all actions, not of its own alone: profiles of class scores, and how usual one is.

A clip of a known action is near to its own exemplars, about as far from those of each other action as its own exemplars are, and
these distances belong together.  A clip of an unknown action may be as near to some class as that, but hardly in such company.
So the exemplars, each asked as if it had not been learned, tell what the profiles of their class look like.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import torch
from torch import Tensor

from indexing.action.options import NearestOptions
from indexing.modelfile import stored

DEFAULTS = NearestOptions()


@dataclass(frozen=True)
class ClassProfiles:
    r"""The profiles of the exemplars of each class: their mean, and how they scatter about it."""

    centres: Tensor = field(metadata=stored("real", "known", "columns"))
    precision: Tensor = field(metadata=stored("real", "columns", "columns"))

    @classmethod
    def learn(cls, profiles: Tensor, labels: Tensor, known: int, options: NearestOptions = DEFAULTS) -> Self | None:
        """From the profiles of the exemplars, each asked without itself. profiles ``(N, columns)``."""
        usable = profiles.isfinite().all(dim=1) & (labels < known)
        own = torch.nn.functional.one_hot(labels[usable], known).to(profiles)
        counts = own.sum(dim=0)
        if not known or int(counts.min()) < 2:
            return None
        centres = own.mT @ profiles[usable] / counts[:, None]
        apart = (profiles[usable] - own @ centres).double()
        scatter = apart.mT @ apart / len(apart)
        ridge = (options.profile_floor * scatter.diagonal()).clamp(min=1e-9)
        return cls(centres, torch.linalg.inv(scatter + ridge.diag()).to(profiles))

    def distance(self, profiles: Tensor, classes: int) -> Tensor:
        r"""``(Q,)`` how unusual profiles ``(Q, columns)`` are, in standard deviations of the class whose they resemble most."""
        apart = profiles[:, None] - self.centres
        # who is nearer to a class than usual, as the same person is, is not unusual for it
        known, columns = self.centres.shape
        own = torch.arange(columns, device=apart.device) % classes == torch.arange(known, device=apart.device)[:, None]
        apart = torch.where(own, apart.clamp(max=0.0), apart)
        squares = torch.einsum("qci,ij,qcj->qc", apart, self.precision, apart)
        return squares.amin(dim=1).clamp(min=0.0).sqrt()
