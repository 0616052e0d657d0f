"""Misuse: always a ``ValueError`` that names the clip or the parameter, and a fitted indexer that stays as it was."""

import numpy as np
import pytest

from indexing import ActionIndexer, Clip
from indexing.actors import Person, dataset

FRAMES, JOINTS = 12, 17


def good(seed=0, **known):
    return Clip(np.random.default_rng(seed).normal(size=(FRAMES, JOINTS, 2)).cumsum(axis=0), **known)


X = good().joints.copy()
BAD_ARRAYS = {
    "two axes": X[:, 0],
    "five axes": X[None, None],
    "one frame": X[:1],
    "fewer joints": X[:, :5],
    "all NaN": np.nan * X,
    "constant": 0 * X + 3,
    "infinite": np.where(np.arange(FRAMES)[:, None, None] == 3, np.inf, X),
    "text": "squat.json",
    "nothing": None,
    "ragged": [[[1.0, 2.0]], [[1.0, 2.0], [3.0, 4.0]]],
    "a dictionary": {"joints": X},
}


def state(indexer):
    """Everything that was learned, comparable."""
    found = {name: value for name, value in vars(indexer).items() if name.endswith("_") and name != "model_"}
    found |= {f"model_.{name}": value for name, value in vars(indexer.model_).items()}
    return {name: (id(value), repr(value)) for name, value in found.items()}


@pytest.fixture(scope="module")
def before(_fitted, others):
    """What was learned, and the answers, before any misuse."""
    return state(_fitted), _fitted.decision_function(others[:2])


@pytest.fixture
def unchanged(indexer, others, before):
    """A fitted indexer that must answer the same afterwards."""
    yield indexer
    learned, answers = before
    assert state(indexer) == learned
    np.testing.assert_array_equal(indexer.decision_function(others[:2]), answers)


# ---- clips -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", BAD_ARRAYS)
def test_bad_clips_are_named_everywhere(kind, unchanged):
    bad = BAD_ARRAYS[kind]
    clips = [good(0), good(1), bad]
    for verb in (
        lambda: unchanged.fit(clips, ["a", "b", "a"]),
        lambda: ActionIndexer().fit(clips, ["a", "b", "a"]),
        lambda: unchanged.partial_fit(clips, ["a", "b", "a"]),
        lambda: unchanged.predict(clips),
        lambda: unchanged.decision_function(clips),
        lambda: unchanged.predict_proba(clips),
        lambda: unchanged.score(clips, ["a", "b", "a"]),
    ):
        with pytest.raises(ValueError, match=r"(clip|item) '?2\b"):
            verb()
    for verb in (unchanged.find, unchanged.score_frames):
        with pytest.raises(ValueError, match=r"clip|item"):
            verb(bad)


ONE, LIST = good(), r"clips: expected a list of clips or arrays, got .*; put a single clip in a list: \[clip\]"
SHORT, SOLID = Clip(X[:1], name="squat-3"), Clip(np.random.default_rng(0).normal(size=(FRAMES, JOINTS, 3)))
NOT_CLIPS = [
    *((clips, "clips: the list is empty; give at least one clip") for clips in ([], (), iter([]), np.empty((0, 5, 17, 2)))),
    *((value, LIST) for value in (ONE, "clips.npz", b"x", None, 5)),
    (X, "several clips are a list"),
    ([Clip(X[:, :5])], r"clip 0: joints: 5 joints, but the fitted clips have 17; use clips of one joint layout"),
    ([ONE, SHORT], r"clip 1 \('squat-3'\): joints: one frame only"),
    ([ONE, (ONE, good(1))], "item 1 holds 2 views; a query is one view"),
]
NOT_VIEWS = [
    ((ONE, Clip(X[:, :5])), "same joints"),
    ((ONE, SOLID), "must be 2D"),
    ((ONE, ONE.replace(times=np.arange(FRAMES) + 100.0, fps=None)), "share no time"),
    ((ONE, ONE.replace(joints=X * np.nan)), "no joint was seen"),
    ((ONE, None), "array of numbers"),
]


def test_queries_and_views_that_are_none_are_named(unchanged):
    for clips, message in NOT_CLIPS:
        with pytest.raises(ValueError, match=message):
            unchanged.predict(clips)
    for clips, message in NOT_CLIPS[:9]:
        for verb in (unchanged.fit, unchanged.partial_fit):
            with pytest.raises(ValueError, match=message):
                verb(clips, [])
    for views, message in NOT_VIEWS:
        for indexer in (ActionIndexer(), unchanged):
            with pytest.raises(ValueError, match=message):
                indexer.fit([ONE, views], ["a", "b"])
    with pytest.raises(ValueError, match=r"(clip|item) 1\b"):  # counted as the user does
        unchanged.fit([(ONE, good(1)), SHORT, good(2)], ["a", "b", "a"])


def flat(joints=JOINTS, seed=0):
    """3D joints in one horizontal plane: a good clip until it is rendered."""
    x = np.random.default_rng(seed).normal(size=(FRAMES, joints, 3))
    x[..., 1] = 2.0
    return Clip(x, name="flat")


def test_failures_late_in_fit_change_nothing(unchanged):
    with pytest.raises(ValueError, match="clip 'flat': the joints have no vertical extent"):
        unchanged.fit([flat(5), flat(5, seed=1)], ["a", "b"])
    with pytest.raises(ValueError, match="'flat'"):
        unchanged.partial_fit([good(), flat()], ["new", "squat"])
    with pytest.raises(ValueError, match="'flat'"):
        unchanged.predict([flat()])


def test_a_crash_in_learning_changes_nothing(unchanged, monkeypatch):
    def crash(*args, **kwargs):
        raise RuntimeError("out of memory")

    monkeypatch.setattr("indexing.action.indexer.learn", crash)
    with pytest.raises(RuntimeError):
        unchanged.fit([Clip(good(s).joints[:, :5]) for s in range(2)], ["a", "b"])
    with pytest.raises(RuntimeError):
        unchanged.partial_fit([good()], ["a new one"])


# ---- labels ------------------------------------------------------------------------------------------------------------
LABELS = [
    (["a", None, "b"], "label of clip 1 is missing"),
    ([1.0, np.nan, 2.0], "label of clip 1 is missing"),
    (np.array(["a", np.nan, "b"], dtype=object), "label of clip 1 is missing"),
    (["a", float("nan"), "b"], "label of clip 1 is missing"),
    (["a", "b"], r"labels: expected one per clip \(3\), got shape \(2,\)"),
    ([["a"], ["b"], ["a"]], "expected one per clip"),
    ([["a"], ["b", "c"], ["a"]], "labels"),
    ("abc", "expected one per clip"),
    (None, r"labels: none given, and clip 0 \(''\) has no label; pass fit\(clips, labels\)"),
    ([1, "wave", 2], "labels: text and numbers are mixed"),
]


def test_bad_labels(unchanged, indexer, others):
    clips = [good(s) for s in range(3)]
    for labels, message in LABELS:
        for one in (ActionIndexer(), unchanged):
            with pytest.raises(ValueError, match=message):
                one.fit(clips, labels)
    for label in (None, float("nan")):
        with pytest.raises(ValueError, match=r"clip 1 .*label|label of clip 1"):
            unchanged.fit([good(0, label="a"), good(1, label=label), good(2, label="b")])
    for more in ([None], [np.nan], ["a", "b"], [3]):
        with pytest.raises(ValueError, match="labels"):
            unchanged.partial_fit([good()], more)
    for truth in (["a"], ["a"] * 3, [["a", "b"]]):
        with pytest.raises(ValueError, match=r"labels: expected one per clip \(2\)"):
            unchanged.score([good(), good(1)], truth)
    with pytest.raises(ValueError, match="none_label=-1 is one of the learned labels; choose another"):
        ActionIndexer(scorer="nearest", reject=0.1).fit(clips, [-1, 0, 1])
    never = others[:4].labels.astype(object)
    never[:2] = "never learned"  # counts as wrong
    assert indexer.score(others[:4], never) == (indexer.predict(others[2:4]) == never[2:]).mean() / 2


# ---- parameters --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("view", "front"), ("view", None), ("view", ["any"]), ("weights", "uniform"), ("scorer", "C"),
        ("mirror", "always"), ("mirror", None), ("fps", 0), ("fps", -30), ("fps", np.nan), ("fps", "30"), ("fps", None),
        ("window", 0), ("window", np.inf), ("stride", 0.0), ("stride", -1),
        ("tempi", ()), ("tempi", (1.0, 0.0)), ("tempi", (np.nan,)), ("tempi", 1.0), ("tempi", None), ("tempi", "fast"),
        ("length", 3), ("length", 12.0), ("length", True), ("length", None), ("virtual_views", -1), ("virtual_views", 1.5),
        ("reject", np.nan), ("reject", "0.1"), ("reject", (0.1,)), ("device", "moon"), ("device", "cuda:99"),
        ("device", 1.5),
        ("random_state", "seed"), ("random_state", -1), ("random_state", 1.5),
    ],
    ids=str,
)  # fmt: skip
def test_bad_parameters_are_named(name, value, unchanged):
    clips, labels = [good(s) for s in range(3)], ["a", "b", "a"]
    old = unchanged.get_params()[name]
    unchanged.set_params(**{name: value})
    for verb in (unchanged.fit, unchanged.partial_fit):
        with pytest.raises(ValueError, match=name):
            verb(clips, labels)
    unchanged.set_params(**{name: old})


def test_windows_cut_otherwise_cannot_be_added(unchanged, lesson):
    for change in ({"length": 20}, {"search": False}, {"virtual_views": 2}):
        old = {name: unchanged.get_params()[name] for name in change}
        unchanged.set_params(**change)
        with pytest.raises(ValueError, match=next(iter(change))):
            unchanged.partial_fit(lesson[:2])
        unchanged.set_params(**old)


# ---- comparisons that would mean nothing ---------------------------------------------------------------------------------
def test_a_query_without_common_joints_is_refused():
    lesson = dataset([Person.random(1)], ["squat", "wave", "kick"], azimuth=0.0, rng=0)

    def keep(clip, joints):
        only = np.full_like(clip.joints, np.nan)
        only[:, joints] = clip.joints[:, joints]
        return clip.replace(joints=only, confidence=None)

    upper, lower = slice(0, 11), slice(11, 17)
    indexer = ActionIndexer(scorer="nearest").fit([keep(clip, upper) for clip in lesson], lesson.labels)
    with pytest.raises(ValueError, match="shares 0 joints with the learned clips, 3 are needed"):
        indexer.predict([keep(lesson[0], lower)])
    assert list(indexer.predict([keep(lesson[0], slice(0, 13))])) == ["squat"]
