"""What tests compute once is computed again for other content."""

import torch
from reference.computed_once import computed_once


def test_results_are_kept_for_equal_content_only():
    given = []
    add = computed_once(lambda values, more: given.append(values.clone()) or float(values.sum()) + more)
    values = torch.ones(2)
    assert add(values, 1) == add(values.clone(), 1) == 3
    assert len(given) == 1
    values[0] = 5
    assert add(values, 1) == 7, "changed in place"
    assert add(values, 2) == 8
    assert len(given) == 3


def test_the_oldest_result_is_forgotten_first():
    given = []
    double = computed_once(lambda value: given.append(value) or 2 * value, most=2)
    assert [double(value) for value in (1, 2, 1, 3, 1, 2)] == [2, 4, 2, 6, 2, 4]
    assert given == [1, 2, 3, 2], "2 was used longest ago when 3 came"


def test_nothing_is_kept_for_tensors_of_another_class():
    given = []
    add = computed_once(lambda values: given.append(values))
    parameter = torch.nn.Parameter(torch.ones(2))
    add(parameter)
    add(parameter)
    assert len(given) == 2
