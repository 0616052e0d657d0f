"""Clips as files of other programs: what comes back, what does not and is said, and what is refused with nothing written."""

import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from indexing import Clip, ClipSet
from indexing.readers import read
from indexing.readers.c3d import read as read_c3d
from indexing.skeleton import COCO17, Skeleton
from indexing.writers import FORMATS, write
from tests.grid import grid

RANDOM = np.random.default_rng(0)
UP = "up is -y, and coordinates are written as they are; programs may take y for up"
FLAT = "the clip is 2D: written with z = 0"
GUESSED = "the units are not known: by the size of the body, m; units says otherwise"


def body(frames=30, joints=17, dims=3, dtype=np.float32, **more):
    """A clip with joints that were not seen, and a frame that shows nobody."""
    values = RANDOM.normal(size=(frames, joints, dims)).astype(dtype)
    values[3, min(4, joints - 1)] = np.nan
    values[frames // 2] = np.nan
    more = {"fps": 50.0, "skeleton": COCO17 if joints == 17 else None, **more}
    return Clip(values, **more)


@grid(("dtype", [np.float32, np.float64]))
def test_trc_and_back(tmp_path, dtype):
    uneven = np.cumsum(RANDOM.uniform(0.001, 0.1, 30)) + 1e5
    clip = body(dtype=dtype, times=uneven, fps=None)
    assert clip.save(tmp_path / "a.trc") == [GUESSED]
    back = read(tmp_path / "a.trc")[0]
    assert np.array_equal(back.joints.astype(dtype), clip.joints, equal_nan=True) and np.array_equal(back.times, clip.times)
    assert back.skeleton.joints == COCO17.joints and back.up == "y"
    assert clip.save(tmp_path / "b.trc", units="mm") == []
    assert np.allclose(1000 * read(tmp_path / "b.trc")[0].joints, clip.joints, rtol=1e-6, equal_nan=True)


def test_trc_has_the_form_that_opensim_writes(tmp_path):
    joints = np.array([[[1.0, 2, 3], [np.nan, 0, 0]], [[4, 5, 6], [7, 8, 9.5]]])
    clip = Clip(joints, times=[0.5, 0.75], fps=4.0, skeleton=Skeleton("s", ("hip", "left\tknee")))
    clip.save(tmp_path / "a.trc", units="m")
    assert (tmp_path / "a.trc").read_text().split("\n") == [
        "PathFileType\t4\t(X/Y/Z)\ta.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        "4.0\t4.0\t2\t2\tm\t4.0\t3\t2",
        "Frame#\tTime\thip\t\t\tleft knee",
        "\t\tX1\tY1\tZ1\tX2\tY2\tZ2",
        "",
        "3\t0.5\t1.0\t2.0\t3.0\t\t\t",
        "4\t0.75\t4.0\t5.0\t6.0\t7.0\t8.0\t9.5",
        "",
    ]


def test_flat_clips(tmp_path):
    clip = body(dims=2, up="-y", confidence=RANDOM.uniform(size=(30, 17)))
    said = [FLAT, UP, "confidences are left out, which the format has no place for"]
    assert clip.save(tmp_path / "a.trc") == clip.save(tmp_path / "a.c3d") == said
    back = read(tmp_path / "a.trc")[0]
    assert np.array_equal(back.joints.astype(np.float32), clip.joints, equal_nan=True) and back.up == "-y"
    found = read_c3d(tmp_path / "a.c3d").values
    assert np.array_equal(found[..., :2], clip.joints, equal_nan=True) and (found[..., 2][~np.isnan(found[..., 2])] == 0).all()


def test_c3d_and_back(tmp_path):
    for up in ("y", "-y", "z"):
        clip = body(times=np.arange(30) / 50 + 0.5, up=up)
        clip.save(tmp_path / "a.c3d", units="mm")
        back = read(tmp_path / "a.c3d")[0]
        assert np.allclose(1000 * back.joints, clip.joints, rtol=1e-5, equal_nan=True) and back.up == up
        assert back.skeleton.joints == COCO17.joints and np.allclose(back.times, clip.times)
    for joints in (1, 17, 300):
        clip = body(joints=joints, fps=59.94)
        assert clip.save(tmp_path / "a.c3d", units="m") == []
        found = read_c3d(tmp_path / "a.c3d")
        assert np.array_equal(found.values.astype(np.float32), clip.joints, equal_nan=True)
        assert found.ids == (COCO17.joints if joints == 17 else tuple(f"joint{i}" for i in range(joints))) and found.first == 1
    clip = Clip(np.arange(66_000 * 3, dtype=np.float32).reshape(-1, 1, 3), fps=120.0)  # more frames than a word says
    clip.save(tmp_path / "a.c3d", units="mm")
    assert np.array_equal(read_c3d(tmp_path / "a.c3d").values, clip.joints)


def header(path):
    """Words and reals of a C3D header by the guide: points, first and last frame, scale, block of the data, rate."""
    data = path.read_bytes()
    assert data[1] == 0x50 and len(data) % 512 == 0
    parameters = (data[0] - 1) * 512
    assert data[parameters + 1] == 0x50 and data[parameters + 3] == 84
    points, _, first, last = struct.unpack_from("<4H", data, 2)
    scale, start = struct.unpack_from("<fH", data, 12)
    assert start == data[0] + data[parameters + 2]  # data come behind as many blocks of parameters as are said
    return points, first, last, scale, struct.unpack_from("<f", data, 20)[0]


def test_c3d_keeps_the_clock(tmp_path):
    frames = np.delete(np.arange(40), [7, 8, 20])
    clip = body(37, times=(frames + 15) / 30)
    assert clip.save(tmp_path / "a.c3d", units="m") == [
        "3 of 40 frames are not there, and are written as if nothing was seen in them"
    ]
    assert header(tmp_path / "a.c3d") == (17, 16, 55, -1.0, 30.0)
    found = read_c3d(tmp_path / "a.c3d")
    assert found.first == 16 and np.isnan(found.values[[7, 8, 20]]).all() and len(found.values) == 40
    assert np.array_equal(found.values[frames].astype(np.float32), clip.joints, equal_nan=True)
    rounded = body(3000, times=np.round(np.arange(3000) / 30, 4))  # steps of 0.0333 and 0.0334 s
    rounded.save(tmp_path / "b.c3d", units="m")
    assert header(tmp_path / "b.c3d")[1:3] == (1, 3000) and header(tmp_path / "b.c3d")[4] == pytest.approx(30, rel=1e-5)
    some = np.cumsum([0, *([5, 6, 4] * 10)])[:30]  # of 30 frames per second every fifth, or so
    assert body(times=some / 30, fps=30.0).save(tmp_path / "d.c3d", units="m")[0].startswith("117 of 147 frames are not there")
    assert header(tmp_path / "d.c3d") == (17, 1, 147, -1.0, 30.0)
    late = body(times=np.arange(30) / 100 + 3600)
    assert late.save(tmp_path / "c.c3d", units="m") == ["it begins at 3600 s, which is 0 in the file"]


def test_several_people(tmp_path):
    first = body(20, skeleton=COCO17)
    both = ClipSet([first.replace(meta={"person": "ann"}), body(20, times=np.arange(10, 30) / 50, meta={"person": "bob"})])
    said = "2 people, their points named ann:nose and so on; other programs read them as one set"
    assert both.save(tmp_path / "a.trc", units="m") == both.save(tmp_path / "a.c3d", units="m") == [said]
    found = read_c3d(tmp_path / "a.c3d")
    assert found.ids[0] == "ann:nose" and found.ids[17] == "bob:nose" and found.values.shape == (30, 34, 3)
    assert np.array_equal(found.values[:20, :17].astype(np.float32), first.joints, equal_nan=True)
    assert np.isnan(found.values[:10, 17:]).all()
    for suffix in (".trc", ".c3d"):
        back = read(tmp_path / f"a{suffix}", person="everyone")
        assert [clip.meta["person"] for clip in back] == ["ann", "bob"] and back[0].skeleton.joints == COCO17.joints
        for clip, given in zip(back, both, strict=True):
            there = given.seen.any(axis=1)
            rows = np.searchsorted(clip.times, given.times[there] - 1e-9)
            assert np.array_equal(clip.joints[rows].astype(np.float32), given.joints[there], equal_nan=True)


def test_units_by_the_size_of_the_body(tmp_path):
    for scale, units in ((1, "m"), (100, "cm"), (1000, "mm")):
        clip = body()
        clip = clip.replace(joints=clip.joints / 2 * scale)
        assert clip.save(tmp_path / "a.trc") == [GUESSED.replace("body, m", f"body, {units}")]
        assert f"\t{units}\t" in (tmp_path / "a.trc").read_text()
        assert clip.replace(meta={"units": "in"}).save(tmp_path / "a.trc") == []


HUNDRED = Skeleton("of a hundred letters", tuple(f"{i:0100}" for i in range(1700)))
REFUSED = {
    "no clips": (".trc", [], "there are no clips to write"),
    "recordings": (".c3d", [body(), body()], "2 clips .* are not the people of one recording"),
    "one person twice": (".trc", [body(meta={"person": 1}), body(meta={"person": 1})], "two clips are of person 1"),
    "2D and 3D": (".trc", [body(meta={"person": 1}), body(dims=2, meta={"person": 2})], "differ in dimensions"),
    "uneven": (".c3d", [body(times=np.cumsum(RANDOM.uniform(0.01, 0.1, 30)))], "times are uneven.*C3D has a rate only; write .trc"),
    "all gap": (".c3d", [body(times=[*range(29), 1e7])], "nearly all gap: 30 of 10000001 frames"),
    "names twice": (".trc", [body(4, 2, skeleton=Skeleton("s", ("a", "a")))], "there are two points 'a'"),
    "long names": (".c3d", [body(skeleton=Skeleton("s", (*COCO17.joints[:16], "x" * 200)))], "is longer than 127 letters"),
    "many long names": (".c3d", [body(4, 1700, skeleton=HUNDRED)], "blocks, and C3D holds 255"),
    "many points": (".c3d", [body(4, 16_384)], "has 16384 points, and C3D holds 16383"),
    "units": (".trc", [body()], "units 'miles' are not known"),
}  # fmt: skip


def test_what_is_refused_leaves_nothing(tmp_path):
    for case, (suffix, clips, message) in REFUSED.items():
        path = tmp_path / f"a{suffix}"
        path.write_text("older")
        with pytest.raises(ValueError, match=message) as caught:
            write(clips, path, "miles" if case == "units" else "m")
        assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
        assert path.read_text() == "older"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.c3d", "a.trc"]


@grid(("suffix", [".trc", ".c3d"]))
def test_what_headers_have_no_place_for(tmp_path, suffix):
    names = ("a\udcff", "b c", *(f"j{i}" for i in range(15)))
    clip = body(skeleton=Skeleton("s", names)).replace(meta={"units": "m\nm" + "x" * 300})
    notes = write([clip], tmp_path / f"a{suffix}")
    assert any("the units are not known" in str(note) for note in notes)
    (back,) = read(tmp_path / f"a{suffix}")
    assert back.skeleton.joints[0] == "a\\udcff" and back.joints.shape == clip.joints.shape


def test_the_suffix_says_the_format_and_the_folder_is_there(tmp_path):
    assert body().save(tmp_path / "a.npz") == []
    assert ClipSet.load(tmp_path / "a.npz")[0].skeleton.joints == COCO17.joints
    with pytest.raises(ValueError, match=rf"no format ends in '.abc'; end the name in one of {', '.join(['.npz', *FORMATS])}$"):
        write([body()], tmp_path / "a.abc")
    for suffix in (*FORMATS, ".npz"):
        with pytest.raises(ValueError, match=r"the folder .* does not exist; create it first"):
            body().save(tmp_path / "none" / f"a{suffix}")


# ---- netCDF, where xarray is -----------------------------------------------------------------------------------------------
def test_netcdf_is_what_xarray_writes(tmp_path, monkeypatch):
    asked = []

    def to_netcdf(path, engine):
        asked.append(engine)
        if engine == "netcdf4" or "b" in working:
            raise ModuleNotFoundError("No module named 'netCDF4'\nwith no backend")
        Path(path).write_bytes(b"written")

    working = "a"
    fake = SimpleNamespace(DataArray=lambda *a, **k: None, Dataset=lambda **k: SimpleNamespace(to_netcdf=to_netcdf))
    monkeypatch.setitem(sys.modules, "xarray", fake)
    assert body().save(tmp_path / "a.nc") == []
    assert (tmp_path / "a.nc").read_bytes() == b"written" and asked == ["netcdf4", "h5netcdf"]
    with pytest.raises(ValueError, match=r"units is for .trc and .c3d; leave it out"):
        body().save(tmp_path / "b.nc", units="m")
    working = "b"
    with pytest.raises(ValueError, match=r"b.nc: xarray cannot write netCDF here .*; pip install xarray") as caught:
        body().save(tmp_path / "b.nc")
    assert "\n" not in str(caught.value)
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ValueError, match=r"datasets of movement need xarray; pip install xarray"):
        body().save(tmp_path / "b.nc")
    assert [path.name for path in tmp_path.iterdir()] == ["a.nc"]


def test_netcdf_and_back(tmp_path):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("netCDF4")
    from indexing.movement import clips_of

    both = ClipSet([body(20, meta={"person": "ann"}), body(20, times=np.arange(10, 30) / 50, meta={"person": "bob"})])
    both.save(tmp_path / "a.nc")
    found = clips_of(xarray.load_dataset(tmp_path / "a.nc"))
    assert [clip.meta["person"] for clip in found] == ["ann", "bob"]
    for clip, given in zip(found, both, strict=True):
        there = np.isin(clip.times, given.times)
        assert np.array_equal(clip.joints[there], given.joints, equal_nan=True) and np.isnan(clip.joints[~there]).all()
        assert clip.skeleton == given.skeleton and clip.up == given.up
    pytest.importorskip("h5py")
    back = read(tmp_path / "a.nc", person="everyone")
    assert [clip.meta["person"] for clip in back] == ["ann", "bob"] and {clip.up for clip in back} == {"y"}
    assert np.array_equal(back[0].joints[~np.isnan(back[0].joints)], both[0].joints[~np.isnan(both[0].joints)])


# ---- independent readers, where they are -----------------------------------------------------------------------------------
def test_c3d_by_other_readers(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    clip = body(times=np.arange(30) / 50 + 1)
    clip.save(tmp_path / "a.c3d", units="mm")
    found = ezc3d.c3d(str(tmp_path / "a.c3d"))
    points = found["data"]["points"][:3].transpose(2, 1, 0)
    assert np.array_equal(points.astype(np.float32), clip.joints, equal_nan=True)
    about = found["parameters"]["POINT"]
    assert about["LABELS"]["value"] == list(COCO17.joints) and about["UNITS"]["value"] == ["mm"] and about["RATE"]["value"] == [50]
    assert found["header"]["points"]["first_frame"] == 50
