"""What the reports on labels share: how many points each body has, how sure each label is, and how right where the file knows."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from indexing.report.page import ResultReport

FloatArray = NDArray[np.float64]
SURE = 0.9  # probability of its label below which a point is called doubtful
# neighbours in the list are apart for colour-blind eyes, too, on both papers and on gray
COLOURS = ("#2f7fb8", "#e8741e", "#2fa36b", "#c2478f", "#b99a0d", "#7d62c9", "#1fa6a6", "#d1493f")


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelledReport(ResultReport):
    """A report on points (matches, tracks) that move each with a body, or with none."""

    ABSENT: ClassVar[str] = ""
    """What a point is called that nothing can be known of."""

    @property
    def present(self) -> NDArray[np.bool_]:
        """``(n,)`` the points that something can be known of."""
        raise NotImplementedError

    @property
    def known(self) -> NDArray[np.int64] | None:
        """``(n,)`` labels that the file has; None where it has none."""
        raise NotImplementedError

    @property
    def bodies(self) -> int:
        """How many bodies."""
        return int(self.found.bodies)

    @property
    def status(self) -> str:
        """The status's name; that there are no bodies is no answer."""
        status = super().status
        return status if status != "OK" or self.bodies else "NO_CONSENSUS"

    @property
    def names(self) -> list[str]:
        """What labels mean: outlier, body 1, body 2, ..."""
        return ["outlier", *(f"body {i}" for i in range(1, self.bodies + 1))]

    @property
    def kinds(self) -> list[str]:
        """What each point is: one of the names, or absent."""
        labels, present = self.found.labels.tolist(), self.present.tolist()
        return [self.names[label] if there else self.ABSENT for label, there in zip(labels, present, strict=True)]

    @functools.cached_property
    def counts(self) -> dict[str, int]:
        """How many points of each kind, bodies first."""
        kinds = self.kinds
        return {name: kinds.count(name) for name in (*self.names[1:], "outlier", self.ABSENT)}

    @property
    def certainty(self) -> FloatArray:
        """``(n,)`` probability of the label of each point; NaN where it is absent."""
        own = np.take_along_axis(self.found.probabilities, self.found.labels[:, None], axis=1)[:, 0]
        return np.where(self.present, own, np.nan)

    @property
    def doubtful(self) -> NDArray[np.bool_]:
        """``(n,)`` points that might well have another label."""
        return np.asarray(self.certainty < SURE)

    def of(self, label: int) -> NDArray[np.bool_]:
        """``(n,)`` the points with a label."""
        return np.asarray(self.present & (self.found.labels == label))

    def rms(self, label: int | None = None) -> float:
        """Root mean square of the residuals of one body, or of all; NaN where there are no points."""
        mine = self.present & (self.found.labels > 0) if label is None else self.of(label)
        return float(np.sqrt(np.mean(np.square(self.found.residuals[mine])))) if mine.any() else float("nan")

    def rms_text(self, label: int | None = None) -> str:
        """The same in three digits, empty where there are no points."""
        value = self.rms(label)
        return f"{value:.3g}" if np.isfinite(value) else ""

    @property
    def misclassified(self) -> float | None:
        """Share of the points that are not labelled as the file says, whatever the bodies' numbers; None where it does not say."""
        if self.known is None or not self.bodies:
            return None
        import torch

        from dyntorch import metrics

        known, present = torch.from_numpy(self.known), torch.from_numpy(self.present)
        return float(metrics.misclassification(self.result.labels[present], known[present]))

    @property
    def values(self) -> dict[str, Any]:
        """What the templates of all such reports show: doubtful points, known labels, the residual."""
        doubtful = ["doubtful" if odd else "" for odd in self.doubtful.tolist()]
        return {"doubtful": doubtful, "compared": self.compared, "rms": self.rms_text(), "share": share}

    @property
    def errors(self) -> list[str]:
        """How many labels are wrong, in a sentence, where the file has labels."""
        wrong = self.misclassified
        return [] if wrong is None else [f"misclassified: {100 * wrong:.2f} % against the labels of the file"]

    @property
    def compared(self) -> list[list[str]]:
        """A row for every body that the file knows: its name, and how many of its points were found to be of which body."""
        if self.known is None or not self.bodies:
            return []
        rows = []
        for label in sorted(np.unique(self.known[self.present]).tolist(), key=lambda label: (label == 0, label)):
            of = self.found.labels[self.present & (self.known == label)]
            cells = [int((of == i).sum()) for i in (*range(1, self.bodies + 1), 0)]
            rows.append([f"body {label}" if label else "outlier", *(f"{cell:,}" if cell else "" for cell in cells)])
        return rows


def share(part: int, whole: int) -> str:
    """A share in whole percents."""
    percent = 100 * part / max(1, whole)
    return "under 1 %" if 0 < percent < 1 else f"{percent:.0f} %"


def colour_of(label: int) -> str:
    """The colour of a body."""
    return COLOURS[(label - 1) % len(COLOURS)]
