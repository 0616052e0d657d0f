"""Numbers of bodies follow a rule, whatever order a search found them in."""

import itertools

import torch

from dyntorch.geometry.pairs import order_of_bodies


def by_hand(labels, count):
    bodies = [[i for i, label in enumerate(labels) if label == k] for k in range(count)]
    return sorted(range(count), key=lambda k: (-len(bodies[k]), bodies[k][0] if bodies[k] else len(labels), k))


def test_all_partitions_of_six_matches_into_three_bodies():
    labels = torch.tensor(list(itertools.product(range(4), repeat=6)))  # 3: in no body
    members = labels[:, None, :] == torch.arange(3)[:, None]
    assert order_of_bodies(members).tolist() == [by_hand(row, 3) for row in labels.tolist()]


def test_the_order_in_which_bodies_were_found_changes_nothing():
    members = torch.eye(4, dtype=torch.bool).repeat_interleave(5, dim=-1)  # four bodies of five matches
    for found in itertools.permutations(range(4)):
        assert members[list(found)][order_of_bodies(members[list(found)])].equal(members)


def test_no_match_and_no_body():
    assert order_of_bodies(torch.zeros(2, 3, 0, dtype=torch.bool)).tolist() == [[0, 1, 2]] * 2
    assert order_of_bodies(torch.zeros(0, 5, dtype=torch.bool)).shape == (0,)
