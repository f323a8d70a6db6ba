"""Each time of a scene is judged against its own truth and the time before."""

from dataclasses import replace
from itertools import pairwise

import torch

from viewmend.evaluation import scene_run
from viewmend.evaluation.film import subject_box
from viewmend.evaluation.scene_run import RunSettings, evaluate_scene


def test_each_time_is_compared_with_the_one_before(small_scenes, monkeypatch):
    asked, score = [], scene_run.score_frame

    def listening(completed, truth, before, *how):
        asked.append((completed, truth, before))
        return score(completed, truth, before, *how)

    monkeypatch.setattr(scene_run, "score_frame", listening)
    scene = replace(small_scenes[0], config=replace(small_scenes[0].config, frames=3))
    run = evaluate_scene(scene, ("nearest",), RunSettings())
    assert run.runs[0].error is None and len(asked) == 3 and asked[0][2] is None
    for (shown, truth, _), (now, _, before) in pairwise(asked):
        assert torch.equal(before.holes, shown.view.holes) and not torch.equal(before.holes, now.view.holes)
        assert torch.equal(before.truth, truth.rgb) and torch.equal(before.completed, shown.rgb)
    assert [completed.view.time for completed, _, _ in asked] == [0, 1, 2]


def test_a_film_shows_all_that_is_rendered_and_all_that_is_true(small_scenes, monkeypatch):
    asked, boxes, score, make = [], [], scene_run.score_frame, scene_run.film

    def listening(completed, truth, before, *how):
        asked.append((completed.view.mask > 0) | truth.mask)
        return score(completed, truth, before, *how)

    monkeypatch.setattr(scene_run, "score_frame", listening)
    monkeypatch.setattr(scene_run, "film", lambda frames, box: (boxes.append(box), make(frames, box))[1])
    scene = replace(small_scenes[0], config=replace(small_scenes[0].config, frames=2))
    evaluate_scene(scene, ("nearest",), RunSettings())
    expected = subject_box(asked[0]).around(subject_box(asked[1]))
    assert len(boxes) == 3 and set(boxes) == {expected}
