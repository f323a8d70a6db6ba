"""Sharing work among threads."""

import os
import threading
from collections.abc import Iterator

import pytest
import torch

from viewmend.geometry.threads import all_threads, one_thread, parallel_for


@pytest.fixture
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 2, 37])
def test_every_item_is_worked_on_once(three_threads, count):
    done = [0] * count

    def work(item: int) -> None:
        done[item] += 1

    parallel_for(work, count)
    assert done == [1] * count


def test_what_fails_is_raised_once_all_have_ended(three_threads):
    def work(item: int) -> None:
        if item == 3:
            raise ValueError("three")

    with pytest.raises(ValueError, match="three"):
        parallel_for(work, 8)


def test_callers_may_be_many_and_within_one_another(three_threads):
    sums = []

    def outer(item: int) -> None:
        parallel_for(lambda n: sums.append(n), 5)

    threads = [threading.Thread(target=parallel_for, args=(outer, 6)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert len(sums) == 4 * 6 * 5


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_has_threads_of_its_own(three_threads):
    parallel_for(lambda n: None, 4)
    child = os.fork()
    if child == 0:
        done = [0] * 4

        def work(item: int) -> None:
            done[item] += 1

        parallel_for(work, 4)
        os._exit(0 if done == [1] * 4 else 1)
    assert os.waitpid(child, 0)[1] == 0


def workers(count: int) -> int:
    """On how many threads work is done that all of them wait for together."""
    seen, together = set(), threading.Barrier(count, timeout=20)

    def work(_: int) -> None:
        seen.add(threading.get_ident())
        together.wait()

    parallel_for(work, count)
    return len(seen)


def test_operations_stay_on_one_thread_except_in_all_threads(three_threads):
    assert torch.get_num_threads() == 3
    with one_thread():
        assert torch.get_num_threads() == 1
        assert workers(3) == 3, "our own loops are shared as ever"
        with all_threads():
            assert torch.get_num_threads() == 3
            with one_thread():
                assert torch.get_num_threads() == 1
            assert torch.get_num_threads() == 3
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3 and workers(3) == 3


def test_threads_are_as_before_after_an_error_and_as_asked_later(three_threads):
    @one_thread()
    def fails() -> None:
        assert torch.get_num_threads() == 1
        raise ValueError

    with pytest.raises(ValueError):
        fails()
    assert torch.get_num_threads() == 3
    torch.set_num_threads(2)
    with one_thread(), all_threads():
        assert torch.get_num_threads() == 2, "nothing is remembered from before"
