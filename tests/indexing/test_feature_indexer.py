"""The table form against scikit-learn's own machine over the same kernel, and files that do not belong together."""

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import save_file
from sklearn.metrics.pairwise import cosine_distances
from sklearn.svm import SVC

from indexing.feature_indexer import FeatureIndexer


@pytest.fixture(scope="module")
def rows():
    rng = np.random.default_rng(0)
    numbers = np.arange(60) % 4
    return rng.normal(size=(4, 5))[numbers] + rng.normal(size=(60, 5)), numbers


@pytest.mark.parametrize("classes", [2, 4])
def test_it_is_a_support_vector_machine_over_the_cosine_kernel(rows, classes):
    x, y = (part[rows[1] < classes] for part in rows)
    indexer = FeatureIndexer().fit(x[:20], y[:20])
    distances = cosine_distances(x[:20])
    scale = np.median(distances[~np.eye(20, dtype=bool)])
    reference = SVC(C=10.0, kernel="precomputed", decision_function_shape="ovr").fit(np.exp(-2 * distances / scale), y[:20])
    kernel = np.exp(-2 * cosine_distances(x[20:], x[:20]) / scale)
    assert indexer.scale_ == pytest.approx(scale / 2, rel=0.02)  # torch takes the lower of two middle values
    assert (indexer.predict(x[20:]) == reference.predict(kernel)).mean() > 0.95
    np.testing.assert_array_equal(indexer.predict(7.0 * x[20:]), indexer.predict(x[20:]))


def test_parts_that_do_not_belong_together_are_refused(rows, tmp_path):
    path = tmp_path / "m.safetensors"
    FeatureIndexer().fit(*rows).save(path)
    with safe_open(path, framework="pt") as file:
        tensors, header = {key: file.get_tensor(key) for key in file.keys()}, file.metadata()  # noqa: SIM118  (no mapping)
    save_file(tensors | {"dual": tensors["dual"][:, :-1].contiguous()}, path, metadata=header)
    with pytest.raises(ValueError, match=r"m\.safetensors: not a model that can be used"):
        FeatureIndexer.load(path)
