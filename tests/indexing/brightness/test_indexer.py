"""The brightness indexer: what it recognizes, and that a stream, a file and an array say the same."""

import json

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from sklearn.base import clone

from indexing.actors import Person, perform
from indexing.actors.textured import render_clip
from indexing.brightness.descriptors import BrightnessOptions
from indexing.brightness.indexer import BrightnessIndexer
from indexing.video import Chunk

ACTIONS = ("squat", "jumping_jack", "bow")


def videos(who, image=(48, 36)):
    return [
        render_clip(perform(action, Person.random(who), fps=15.0, rng=who), azimuth=0, image=image, rng=10 * who)
        for action in ACTIONS
    ]


@pytest.fixture(scope="module")
def learned():
    return videos(1) + videos(2)


@pytest.fixture(scope="module")
def indexer(learned):
    return BrightnessIndexer(fps=15.0).fit(learned, ACTIONS * 2)


@pytest.fixture(scope="module")
def asked():
    return videos(3)


@pytest.mark.slow
def test_another_person_is_recognized(indexer, asked):
    assert indexer.predict(asked).tolist() == list(ACTIONS)
    assert np.allclose(indexer.predict_proba(asked).sum(1), 1)
    assert indexer.score(asked, ACTIONS) == 1
    inverted = [255 - video for video in asked]
    assert np.allclose(indexer.decision_function(inverted), indexer.decision_function(asked), atol=0.02)


def test_a_stream_gives_what_a_video_gives_and_never_looks_ahead(indexer, asked):
    whole = indexer.score_frames(asked[0])
    assert whole.shape == (len(asked[0]), 3)
    stream = indexer.stream()
    single = np.stack([stream.push(frame) for frame in asked[0][:20]])
    np.testing.assert_allclose(single, whole[:20], atol=1e-5)
    np.testing.assert_allclose(indexer.score_frames(asked[0][:33]), whole[:33], atol=1e-5)
    colour = np.repeat(asked[0][:20, :, :, None], 3, axis=3)
    np.testing.assert_allclose(indexer.stream().push(colour), whole[:20], atol=0.02)
    twice = np.repeat(asked[0], 2, axis=0).astype(float)  # frame rates are brought together
    twice[1:-1:2] = (twice[1:-1:2] + twice[2::2]) / 2
    np.testing.assert_allclose(indexer.stream(fps=30.0).push(twice / 255)[::2], whole, atol=0.05)


def test_files_are_read_in_chunks(indexer, asked, tmp_path):
    av = pytest.importorskip("av")
    path = tmp_path / "video.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=15)
        stream.height, stream.width, stream.pix_fmt = *asked[2].shape[1:], "gray"
        for image in asked[2]:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        container.mux(stream.encode())
    np.testing.assert_allclose(indexer.score_frames(path), indexer.score_frames(asked[2]), atol=1e-5)
    assert indexer.predict([path, str(path)]).tolist() == ["bow", "bow"]


def test_chunks_with_times_are_videos(indexer, asked):
    def chunks(video, times):
        return [Chunk(video[begin : begin + 20], times[begin : begin + 20]) for begin in range(0, len(video), 20)]

    whole = indexer.score_frames(asked[1])
    even = 2.0 + np.arange(len(asked[1])) / 15
    shares = []
    times, scores, events = indexer.scan(chunks(asked[1], even), shares.append)
    assert np.array_equal(times, even)
    np.testing.assert_allclose(scores, whole, atol=1e-5)
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    assert all(2.0 <= event.start < event.end <= even[-1] for event in events)
    kept = np.sort(np.random.default_rng(0).choice(len(even), len(even) * 3 // 4, replace=False))  # dropped frames
    uneven = indexer.score_frames(chunks(asked[1][kept], even[kept]))
    assert (uneven.argmax(1) == whole[kept].argmax(1)).mean() > 0.7
    assert indexer.predict([chunks(asked[1][kept], even[kept])]).tolist() == ["jumping_jack"]


def test_events_are_found(indexer, asked):
    rest = np.repeat(asked[0][-1:], 15, axis=0)
    found = indexer.find(np.concatenate([rest, asked[0], rest]))
    best = max(found, key=lambda event: event.end - event.start)
    assert best.label == "squat"
    assert 0.8 < best.start < best.end < len(asked[0]) / 15 + 1.4


@pytest.mark.slow
def test_files_of_models_are_exact(indexer, asked, tmp_path):
    path = tmp_path / "model.safetensors"
    model = clone(indexer).set_params(reject=0.2, region=(2, 0, 46, 36)).fit(asked, [3, 1, 2])
    model.save(path)
    again = BrightnessIndexer.load(path)
    assert again.get_params() | {"region": None} == model.get_params() | {"region": None}
    assert again.classes_.dtype == model.classes_.dtype and again.reject_threshold_ == model.reject_threshold_
    assert np.array_equal(again.decision_function(asked), model.decision_function(asked))
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="not a model file"):
        BrightnessIndexer.load(path)


def test_files_from_before_the_window_kernel_went_are_read_where_it_had_no_weight(indexer, asked, tmp_path):
    indexer.save(tmp_path / "model.safetensors")
    with safe_open(tmp_path / "model.safetensors", framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        header = json.loads(file.metadata()["dyntorch"])
    path, tensors["kernels"] = tmp_path / "old.safetensors", torch.zeros(len(tensors["motion"]), 0)
    for weight in (0.0, 0.6):
        header["parameters"]["temporal_weight"] = weight
        save_file(tensors, path, metadata={"dyntorch": json.dumps(header)})
        if weight == 0:
            assert np.array_equal(BrightnessIndexer.load(path).decision_function(asked), indexer.decision_function(asked))
    with pytest.raises(
        ValueError, match=r"old\.safetensors.*temporal_weight=0\.6: window kernels are no longer mixed into scores.*fit on"
    ):
        BrightnessIndexer.load(path)


@pytest.mark.slow
def test_order_and_parts_of_the_exemplars_do_not_matter(indexer, learned, asked):
    expected = indexer.decision_function(asked[:1])
    turned = clone(indexer).fit(learned[::-1], (ACTIONS * 2)[::-1])
    np.testing.assert_allclose(turned.decision_function(asked[:1]), expected, atol=1e-6)
    parts = clone(indexer).partial_fit(learned[:2], ACTIONS[:2]).partial_fit(learned[2:], (ACTIONS * 2)[2:])
    np.testing.assert_allclose(parts.decision_function(asked[:1]), expected, atol=5e-3)
    parts.set_params(size=64)
    with pytest.raises(ValueError, match="changed since fit"):
        parts.partial_fit(learned[:1], ["bow"])


def test_unknown_actions_are_rejected(indexer, learned, asked):
    strict = clone(indexer).set_params(reject=2.0, none_label="none").fit(learned[:3], ACTIONS)
    assert strict.predict(asked[:1]).tolist() == ["none"]
    still = np.repeat(asked[0][:1], 8, axis=0)
    assert indexer.decision_function([still]).tolist() == [[0, 0, 0]]
    assert clone(indexer).set_params(reject=0.3, none_label="none").fit(learned[:3], ACTIONS).predict([still]) == ["none"]


def test_mirrored_exemplars_count_unless_sides_matter(indexer, learned):
    assert indexer.flip_
    wave = render_clip(perform("wave", Person(), fps=15.0), azimuth=0, image=(48, 36), rng=3)
    sided = clone(indexer).fit([wave, wave[:, :, ::-1].copy()], ["right", "left"])
    assert not sided.flip_
    mirrored = wave[:, :, ::-1].copy()
    assert clone(indexer).set_params(flip=True).fit([mirrored, learned[0]], ["wave", "squat"]).predict([wave]) == ["wave"]


BAD = {
    "list of arrays or paths, got str": ("video.mp4", ["a"], {}),
    "the list is empty": ([], [], {}),
    "too small or too narrow": ([np.zeros((5, 8, 9), np.uint8)] * 2, ["a", "b"], {}),
    "nothing moves": ([np.zeros((5, 32, 32), np.uint8)] * 2, ["a", "b"], {}),
    "convert them to uint8": ([np.zeros((5, 32, 32), np.int64)] * 2, ["a", "b"], {}),
    r"colour \(h, w, 3\)": ([np.zeros((5, 32, 32, 4), np.uint8)] * 2, ["a", "b"], {}),
    "only one class": ([np.zeros((5, 32, 32), np.uint8)] * 2, ["a", "a"], {}),
    "expected one per clip": ([np.zeros((5, 32, 32), np.uint8)] * 2, ["a"], {}),
    "no such file": (["nothing.mp4", "none.mp4"], ["a", "b"], {}),
    "got list": ([[1, 2], [3]], ["a", "b"], {}),
    r"got shape \(32, 32\)": ([np.zeros((32, 32))] * 2, ["a", "b"], {}),
    "2 frames; motion needs": ([np.eye(32)[None] * np.ones((2, 1, 1))] * 2, ["a", "b"], {}),
    "region must be": ([], [], {"region": (5, 0, 2, 9)}),
    "flip must be": ([], [], {"flip": "no"}),
    "window must be": ([], [], {"window": 0}),
    "pool must be": ([], [], {"pool": -1}),
    "size must be": ([], [], {"size": 8}),
    "reject must be": ([], [], {"reject": "much"}),
    "device 'nowhere' is not there": ([], [], {"device": "nowhere"}),
}


def test_bad_input_is_named(indexer):
    for words, (source, labels, options) in BAD.items():
        with pytest.raises(ValueError, match=words):
            BrightnessIndexer(**options).fit(source, labels)
    with pytest.raises(ValueError, match="fps must be"):
        indexer.stream(fps=0)
    stream = indexer.stream()
    stream.push(np.zeros((36, 48), np.uint8))
    with pytest.raises(ValueError, match="those before 48 x 36"):
        stream.push(np.zeros((40, 48), np.uint8))


@pytest.mark.slow
def test_options_are_kept_where_they_are_not_the_defaults(indexer, learned, asked, tmp_path):
    options = BrightnessOptions(blur_sigma=2.0, noise_level=0.008, motion_memory=2.0, num_directions=8)
    taught = clone(BrightnessIndexer(fps=15.0, options=options)).fit(learned, ACTIONS * 2)
    taught.save(tmp_path / "m.safetensors")
    again = BrightnessIndexer.load(tmp_path / "m.safetensors")
    assert again.options == options and again.recognizer_.library.rows.shape[1] == 8
    np.testing.assert_array_equal(again.decision_function(asked), taught.decision_function(asked))
    assert not np.array_equal(again.decision_function(asked), indexer.decision_function(asked))
    with pytest.raises(ValueError, match="options were changed since fit"):
        again.set_params(options=None).partial_fit(asked, ACTIONS)
