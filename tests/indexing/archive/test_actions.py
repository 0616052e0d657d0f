"""Learned actions in an archive: what the indexer finds in each recording, wherever somebody moves as an exemplar does."""

import numpy as np
import pytest

from indexing import ActionIndexer, Archive, Clip
from indexing.actors import ACTIONS, Person, dataset, detect, stream


@pytest.fixture(scope="module")
def indexer():
    learned = dataset([Person.random(seed) for seed in range(2)], ["kick", "wave", "squat", "bow"], azimuth=0.0, rng=1)
    return ActionIndexer(random_state=0).fit(list(learned), learned.labels)


@pytest.fixture(scope="module")
def recordings():
    rng = np.random.default_rng(0)
    made = [stream(rng.choice(ACTIONS, 6).tolist(), Person.random(10 + seed), rng=seed) for seed in range(3)]
    return [detect(points, azimuth=60.0, rng=seed).replace(name=f"day {seed}") for seed, (points, _) in enumerate(made)]


@pytest.fixture(scope="module")
def archive(recordings, tmp_path_factory):
    found = Archive(tmp_path_factory.mktemp("found") / "lab")
    found.add(recordings)
    return found


def alike(one, others):
    return any(
        one.label == other.label and min(one.end, other.end) - max(one.start, other.start) > 0.5 * (other.end - other.start)
        for other in others
    )


@pytest.mark.slow
def test_events_are_those_of_the_recordings(archive, recordings, indexer):
    found = archive.find(indexer)
    kept, right = [], []
    for clip in recordings:
        mine, whole = [one for one in found if one.source == clip.name], indexer.find(clip)
        kept += [alike(one, mine) for one in whole]
        right += [alike(one, whole) for one in mine]
    assert np.mean(kept) >= 0.8 and np.mean(right) >= 0.8
    assert found == sorted(found, key=lambda one: (one.source, one.person, one.start, one.end))


@pytest.mark.slow
def test_a_model_file_does(archive, indexer, tmp_path):
    indexer.save(tmp_path / "moves.safetensors")
    assert archive.find(tmp_path / "moves.safetensors") == archive.find(indexer)


def test_who_stands_still_is_not_looked_at(indexer, recordings, tmp_path):
    pose = recordings[0].joints[5]
    still = pose + np.random.default_rng(0).normal(scale=0.5, size=(900, *pose.shape))
    archive = Archive(tmp_path / "a")
    archive.add(Clip(still, fps=30.0, name="still", up="-y", skeleton=recordings[0].skeleton))
    assert archive.find(indexer) == []


def test_joints_that_the_archive_does_not_have(archive):
    rng = np.random.default_rng(0)
    clips = [Clip(rng.normal(size=(40, 5, 2)), fps=30.0) for _ in range(4)]
    with pytest.raises(ValueError, match="too few in common"):
        archive.find(ActionIndexer().fit(clips, ["a", "a", "b", "b"]))
