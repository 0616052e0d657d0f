"""How the pictures of the gallery look."""

from __future__ import annotations

import warnings
from typing import Any

import matplotlib as mpl


def apply(gallery: dict[str, Any], file: str) -> None:
    """Before every example; in one, a name that has moved is an error."""
    warnings.filterwarnings("error", category=DeprecationWarning, message="dyntorch", module="__main__")
    mpl.rcdefaults()
    mpl.rcParams.update(
        {
            "figure.figsize": (8.0, 4.0),
            "figure.dpi": 110,
            "figure.constrained_layout.use": True,
            "font.size": 10,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.titlesize": 11,
            "axes.titlelocation": "left",
            "axes.prop_cycle": mpl.cycler(color=["#2a76aa", "#d9822b", "#3d8c5f", "#b8433c", "#7a5ea8", "#8a8a8a"]),
            "legend.frameon": False,
            "lines.linewidth": 1.8,
        }
    )
