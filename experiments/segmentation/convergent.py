"""Static points and points on convergent lines of a plane, two views: the convergent motion matrix beside other ways.

    python -m experiments.segmentation.convergent --quick

Scenes of :func:`dyntorch.scenes.convergent_motions` (traffic on a straight road). Wrong labels under the better naming of both
groups, and the relative error of the homography of the road in normalized coordinates. "segmentation matrix" does not know that
both matrices share a homography (14 parameters instead of 12), ``segment`` does not know the model at all, "true matrices" is the
limit.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.metrics import misclassification, relative_error
from dyntorch.scenes import Scene, convergent_motions
from experiments.common.runner import SceneConfig, Tables, Words, experiment

KIND = dyn.ConvergentMotionMatrix
SETTINGS = tuple((n, sigma) for n in (60, 200, 500) for sigma in (0.1, 0.5, 1.0))
TURNS = 5
"""Of weights and fits before the refinement, as the invariant's documentation has it."""
HEAD = (
    "matches",
    "noise px",
    "linear",
    "refined",
    "segmentation matrix",
    "segment",
    "true matrices",
    "road: linear",
    "road: refined",
)


def wrong(labels: Tensor, scene: Scene) -> float:
    """Share of matches with the wrong label."""
    return float(misclassification(labels, scene.labels))


def road(tensor: Tensor, scene: Scene) -> float:
    """Relative error of the homography of the plane, in units of the focal length."""
    K = scene.extras["calibration"]
    H, *_ = KIND.static_first(*KIND.decompose(tensor), K, K)
    inverse = torch.linalg.inv(K)
    return float(relative_error(inverse @ H @ K, inverse @ scene.extras["homography"] @ K))


def scene_errors(n: int, sigma: float, draw: torch.Generator) -> list[float]:
    """All figures of one scene."""
    scene = convergent_motions(n, sigma=sigma, generator=draw)
    linear = dyn.fit(KIND, *scene.views)
    fitted = linear
    for _ in range(TURNS):
        fitted = dyn.fit(KIND, *scene.views, weights=KIND.reweight(fitted.tensor, *scene.views))
    refined = dyn.refine(fitted, *scene.views, weights=torch.ones(n))
    pair = dyn.fit(dyn.SegmentationMatrix, *scene.views)
    pair = dyn.refine(pair, *scene.views)
    matrices = [KIND.fundamentals(found.tensor) for found in (linear, refined)]
    matrices += [dyn.SegmentationMatrix.fundamentals(pair.tensor)]
    labels = [wrong(KIND.labels(*pair, *scene.views), scene) for pair in matrices]
    segmented = dyn.segment(*scene.views, bodies=2, threshold=3 * sigma, generator=draw)
    labels += [wrong(segmented.labels, scene), wrong(KIND.labels(*scene.motion, *scene.views), scene)]
    return [*labels, road(fitted.tensor, scene), road(refined.tensor, scene)]


def line(n: int, sigma: float, scenes: int, seed: int) -> Sequence[str]:
    """One row: means of the labels, medians of the errors."""
    values = torch.tensor([scene_errors(n, sigma, torch.Generator().manual_seed(1000 * seed + k)) for k in range(scenes)])
    shares, errors = values[:, :5].mean(0), values[:, 5:].median(0).values
    return str(n), f"{sigma:g}", *(f"{share:.1%}" for share in shares.tolist()), *(f"{error:.2g}" for error in errors.tolist())


@experiment(SceneConfig(scenes=20), quick={"scenes": 5})
def tables(config: SceneConfig) -> Tables:
    """Wrong labels and the homography of the plane over the matches and the noise."""
    chosen = [setting for setting in SETTINGS if not config.quick or setting[1] == 0.5]
    lines = [line(*setting, config.scenes, config.seed) for setting in chosen]
    yield f"wrong labels (means) and error of the road (medians), {config.scenes} scenes a row", Words(HEAD, lines)
