"""Blocks on a thread pool: the same as the function on the whole batch, with gradients, errors and the thread setting intact."""

import os
import threading
import time

import pytest
import torch

from dyntorch.blocks import map_blocks


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("batch", [0, 1, 6, 7, 23])
@pytest.mark.parametrize("threads", [1, 2])
def test_blocks_equal_the_whole(batch, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    x = torch.arange(batch * 3.0).reshape(batch, 3)
    y = torch.arange(batch)
    total, twice = map_blocks(lambda a, b: (a.sum(-1) + b, 2 * a), x, y, size=3)
    torch.set_num_threads(before)
    assert torch.equal(total, x.sum(-1) + y)
    assert torch.equal(twice, 2 * x)


def test_a_single_tensor_comes_back_as_a_tensor(two_threads):
    assert torch.equal(map_blocks(torch.neg, torch.arange(5), size=2), -torch.arange(5))


def test_blocks_run_at_the_same_time_in_other_threads(two_threads):
    meeting = threading.Barrier(2, timeout=10)  # broken, hence an error, unless two blocks are there together

    def block(x):
        meeting.wait()
        return torch.full_like(x, threading.get_ident())

    found = map_blocks(block, torch.zeros(4, dtype=torch.int64), size=2)
    assert threading.get_ident() not in found.tolist()
    assert len(set(found.tolist())) == 2


def test_workers_have_one_thread_and_everybody_else_keeps_theirs(two_threads):
    def block(x):
        time.sleep(0.01)  # both workers take part
        return torch.full_like(x, torch.get_num_threads())

    seen = []
    assert set(map_blocks(block, torch.zeros(8), size=1).tolist()) == {1.0}
    assert torch.get_num_threads() == 2
    other = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
    other.start()
    other.join()
    assert seen == [2]


def test_grad_mode_is_the_callers(two_threads):
    x = torch.randn(6, 2, generator=torch.Generator().manual_seed(0), requires_grad=True)
    result = map_blocks(torch.square, x, size=2)
    result.sum().backward()
    torch.testing.assert_close(x.grad, 2 * x.detach())
    with torch.no_grad():
        assert not map_blocks(torch.square, x, size=2).requires_grad
    with torch.inference_mode():
        assert map_blocks(torch.square, x, size=2).is_inference()


def test_one_thread_stays_in_the_calling_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    found = map_blocks(lambda x: torch.full_like(x, threading.get_ident()), torch.zeros(4, dtype=torch.int64), size=1)
    torch.set_num_threads(before)
    assert set(found.tolist()) == {threading.get_ident()}


def test_an_error_in_a_block_reaches_the_caller(two_threads):
    def block(x):
        raise KeyError("block")

    with pytest.raises(KeyError, match="block"):
        map_blocks(block, torch.zeros(4), size=1)


def test_blocks_inside_blocks_do_not_wait_for_each_other(two_threads):
    found = map_blocks(lambda x: map_blocks(torch.neg, x, size=1), torch.arange(8), size=2)
    assert torch.equal(found, -torch.arange(8))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_process_gets_a_pool_of_its_own(two_threads):
    map_blocks(torch.neg, torch.arange(4), size=1)
    child = os.fork()
    if child == 0:
        ok = torch.equal(map_blocks(torch.neg, torch.arange(4), size=1), -torch.arange(4))
        os._exit(0 if ok else 1)
    for _ in range(500):
        done, code = os.waitpid(child, os.WNOHANG)
        if done:
            assert code == 0
            return
        time.sleep(0.01)
    os.kill(child, 9)
    os.waitpid(child, 0)
    pytest.fail("the child waits for threads that did not survive the fork")


def test_misuse_is_refused():
    with pytest.raises(ValueError, match=r"same leading dimension.*\(2,\).*\(3,\)"):
        map_blocks(torch.add, torch.zeros(2), torch.zeros(3), size=1)
    with pytest.raises(ValueError, match="same leading dimension"):
        map_blocks(torch.neg, torch.tensor(1.0), size=1)
    with pytest.raises(ValueError, match="same leading dimension"):
        map_blocks(torch.neg, size=1)
    with pytest.raises(ValueError, match="size must be at least 1"):
        map_blocks(torch.neg, torch.zeros(2), size=0)
