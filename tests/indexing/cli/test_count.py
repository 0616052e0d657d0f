"""``dyntorch count``: what it prints, as text and as JSON, and what it refuses."""

from __future__ import annotations

import json

import pytest

COMMAND = "count"


def cells(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.strip()]


def test_numbers_of_matches_and_dimensions(run):
    code, out, err = run("homography", "--moving", "30", "--static", "2")
    assert (code, err) == (0, "")
    lines = cells(out)
    assert out.startswith("Points of a plane that move along straight lines, three views: homography tensor")
    assert ["static", "2", "2", "2"] in lines and ["moving", "30", "24", "26"] in lines
    assert "rank 26 of 27, nullity 1, from 26 of 32 matches\nenough: more matches do not raise the rank\n" in out
    assert run("--dim-v", "3", "3", "2") == (0, "dim V(3, 3, 2) = 26\n", "")
    assert json.loads(run("--dim-v", "3", "4", "2", "--json")[1]) == {"n": 3, "m": 4, "k": 2, "dim_v": 72}


def test_too_few_matches_say_how_many_are_missing(run):
    code, out, _ = run("homography", "--lines", "8", "8", "8", "2")
    assert code == 0
    assert [line for line in cells(out) if line[0] == "line"] == [
        ["line", "8", "8", "8"], ["line", "8", "7", "15"], ["line", "8", "6", "21"], ["line", "2", "2", "23"],
    ]  # fmt: skip
    assert "nullity 4, from 23 of 26 matches\nnot enough: rank 26 takes 3 more matches (moving)" in out
    result = json.loads(run("homography", "--static", "12", "--moving", "1", "--json")[1])
    assert result["profile"] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 10, 10, 11]
    assert (result["rank"], result["nullity"], result["minimal"], result["missing"]) == (11, 16, 11, 15)
    assert result["kinds"][0] == {"name": "static", "matches": 12, "useful": 10, "rank": 10}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("constant_velocity_3d --static 100", "3D points with constant velocities: Grassmann tensor P^6 -> P^2\nrank 44 of 81"),
        ("constant_velocity_3d --static 100", "not enough: rank 80 takes 18 more matches (moving)\n"),
        ("constant-velocity-3d --camera fixed --times 0 1 2 4", "rank 75 of 81, nullity 6, from 38 matches\ndegenerate views"),
        ("constant_velocity_3d --camera fixed --static 50", "degenerate views: no matches exceed rank 75, so"),
        ("constant_velocity_2d --profile 2 1 1 1", "rank 80 of 81, nullity 1, from 10 matches\nenough"),
        ("two_bodies_3d --objects 60 2", "rank 26 of 27, nullity 1, from 13 of 62 matches\nenough"),
        ("--k 6 --profile 2 2 2 1", "points of P^6 that stay, views P^2, P^2, P^2, P^2\nrank 80 of 81, nullity 1, from 40 matches"),
        ("--k 6 --profile 3 3 1 --views 3 3 2", "rank 47 of 48, nullity 1, from 24 matches"),
        ("homography --labelled-static 3", "rank 21 of 27, nullity 6, from 3 matches\nnot enough: rank 26 takes 5 more"),
        ("--k 3 --views 2 2 2 2 --r 2", "points of P^3 that move within extensors of 2 points, views P^2, P^2, P^2, P^2\n"),
        ("--k 3 --views 2 2 2 2 --r 2", "rank 81 of 81, nullity 0, from 81 matches\nno constraint"),
        ("--k 6 --views 3 3 3 --measure join join hyper", "rank 63 of 64, nullity 1, from 21 matches"),
        ("--k 3 --views 2 2 --matches 5", "rank 5 of 9, nullity 4, from 5 matches\nnot enough: rank 8 takes 3 more"),
        ("shape-tensor --general --synthetic", "rank 80 of 81, nullity 1, from 2 matches\nenough"),
        ("shape-tensor --points 7 --general --synthetic", "rank 26 of 27, nullity 1, from 3 matches\nenough"),
        ("shape-tensor --points 6 --general --synthetic", "rank 8 of 9, nullity 1, from 4 matches\nenough"),
        ("shape-tensor --points 6 --synthetic", "rank 8 of 9, nullity 1, from 2 matches\nenough"),
        ("shape-tensor --synthetic --images 1", "takes 1 more match (image)"),
    ],
)  # fmt: skip
def test_what_is_counted(run, words, expected):
    code, out, err = run(*words.split())
    assert (code, err) == (0, "") and expected in out


@pytest.mark.slow
def test_lifted_and_moving_shapes(run):
    assert "rank 20 of 30, nullity 10, from 10 matches" in run("lifted-shape")[1]
    assert "rank 119 of 120, nullity 1, from 4 matches\nenough" in run("lifted_shape", "--points", "10", "--synthetic")[1]
    assert "rank 49 of 60, nullity 11, from 49 matches" in run("dynamic_shape")[1]
    assert "rank 8 of 9, nullity 1, from 8 matches" in run("dynamic_shape", "--coplanar-base")[1]


@pytest.mark.slow
def test_table_of_all(run):
    code, out, _ = run()
    assert code == 0
    rows = {line[0]: line[1:6] for line in cells(out)}
    assert rows["join"] == ["64", "60", "4", "60", "moving"]
    assert rows["trifocal"] == ["27", "26", "1", "7", "static"]
    assert rows["constant_velocity_planes_3d"] == ["81", "80", "1", "20", "moving"]
    assert max(map(len, out.splitlines())) <= 132
    listed = json.loads(run("--json")[1])
    assert {entry["name"] for entry in listed} <= rows.keys() and len(listed) == 26


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("homografy", "unknown configuration 'homografy'; known are homography, dual_homography"),
        ("homography --coplanar 3", "homography has no option coplanar; it has moving, static"),
        ("homography --static -1", "static must be a number from 0 to 1,000,000, got -1"),
        ("homography --static x", "--static"),
        ("homography --k 2", "exclude each other"),
        ("homography --dim-v 3 3 2", "exclude each other"),
        ("--static 3", "--static needs a configuration before it"),
        ("--labelled-static 3", "--labelled-static needs a configuration"),
        ("--k 2", "numbers need at least --k"),
        ("--views 2 2", "numbers need at least --k"),
        ("--profile 2 2 1", "numbers need at least --k"),
        ("--k 4 --profile 2 2 1 --camera fixed", "no option camera"),
        ("--camera fixed", "--camera needs a configuration before it"),
        ("homography --profile 2 1 1", "homography has no option profile"),
        ("constant_velocity_2d --profile 2 2 2", "add up to k + 1 = 5, got [2, 2, 2]"),
        ("static_3d --camera along", "camera must be one of generic, fixed"),
        ("constant_velocity_2d --camera up", "--camera"),
        ("--k 2 --views 2 2 --m 3 --r 2", "expected 1 <= m <= r <= k + 1"),
        ("--k 2 --views 2 2 --measure meet", "--measure"),
        ("--k 2 --views 2 2 --measure join join join", "measure must be join or hyper"),
        ("--k 9 --views 9 9 9 9", "10,000 unknowns are too many"),
        ("--dim-v 3 3", "--dim-v"),
        ("shape_tensor --points 5", "points must be 6, 7 or 8, got 5"),
        ("homography --general", "homography has no option general"),
        ("--points 7", "--points needs a configuration before it"),
        ("--dim-v 0 3 1", "n must be an integer of at least 1, got 0"),
        ("homography --seed -1", "seed must be"),
    ],
)
def test_bad_input_is_one_line_and_code_2(run, words, message):
    code, out, err = run(*words.split())
    assert (code, out) == (2, "")
    assert err.startswith("dyntorch: ") and err.count("\n") == 1 and message in err


def test_how_many_of_a_kind_count_at_most(run):
    code, out, _ = run("join", "--on-plane", "40", "--static", "30", "--moving", "0")
    assert code == 0 and "rank 36 of 64, nullity 28, from 36 of 70 matches\n" in out
    assert "not enough: rank 60 takes 24 more matches (moving)\nat most 20 static, 26 on plane count\n" in out
    assert json.loads(run("homography", "--on-line", "9", "--json")[1])["at_most"] == {"on_line": 8}
    code, out, _ = run("--k", "3", "--views", "3", "3", "3", "--r", "2", "--on-plane", "30", "--static", "2")
    assert code == 0 and ["on", "plane", "30", "26", "28"] in cells(out) and "rank 60 of 64" in out
    assert "rank 72 of 81, nullity 9" in run("dynamic", "--dim", "2", "--poses", "4", "--within", "2")[1]


@pytest.mark.slow
def test_the_page_of_minimal_conditions_is_right():
    from experiments.alignment.minimal_conditions import rows
    from experiments.common.results import RESULTS

    page = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in (RESULTS / "alignment-minimal_conditions.md").read_text().splitlines()
    ]
    for name in [
        "homography",
        "minimal_join",
        "constant_velocity",
        "lines",
        "fundamental",
        "segmentation",
        "shape_tensor",
        "constant_velocity_2d",
    ]:
        wanted = [list(row) for row in rows(name)]
        at = page.index(wanted[0])
        assert page[at : at + len(wanted)] == wanted, name
