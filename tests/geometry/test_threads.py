"""Sharing work among threads."""

import os
import threading

import pytest
import torch

from viewmend.geometry.threads import parallel_for


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 2, 37])
def test_every_item_is_worked_on_once(two_threads, count):
    done = [0] * count

    def work(item: int) -> None:
        done[item] += 1

    parallel_for(work, count)
    assert done == [1] * count


def test_what_fails_is_raised_once_all_have_ended(two_threads):
    def work(item: int) -> None:
        if item == 3:
            raise ValueError("three")

    with pytest.raises(ValueError, match="three"):
        parallel_for(work, 8)


def test_callers_may_be_many_and_within_one_another(two_threads):
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
def test_a_forked_child_has_threads_of_its_own(two_threads):
    parallel_for(lambda n: None, 4)
    child = os.fork()
    if child == 0:
        done = [0] * 4

        def work(item: int) -> None:
            done[item] += 1

        parallel_for(work, 4)
        os._exit(0 if done == [1] * 4 else 1)
    assert os.waitpid(child, 0)[1] == 0
