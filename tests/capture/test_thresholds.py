"""Where findings begin: what is too much of one camera beside its peers, and what several are together."""

from dataclasses import replace

import pytest
import torch
from reference.ball import photograph, ring

from viewmend.capture import diagnosis, peers
from viewmend.capture.diagnosis import faulty_masks
from viewmend.capture.peers import Peers, odd_camera


@pytest.fixture(scope="module")
def ball():
    return photograph(ring(8))


def of_peers(monkeypatch, ball, sticks_out, takes):
    """What is said if the peers say this of eight cameras."""
    nothing = torch.zeros(8, 1, 1, dtype=torch.bool)
    told = Peers(nothing, torch.tensor(takes), torch.tensor(sticks_out))
    monkeypatch.setattr(peers, "ask_peers", lambda frame, bounds: told)
    return [(f.text, f.camera) for f in odd_camera(ball, None)]


@pytest.mark.parametrize(
    ("usual", "own", "found"),
    [(0.1, 0.44, False), (0.1, 0.46, True), (0.0, 0.14, False), (0.0, 0.16, True), (0.0, 0.31, True)],
)
def test_masks_that_stick_out_are_judged_beside_what_is_usual(monkeypatch, ball, usual, own, found):
    """Rigs of dilated masks stick out everywhere: a camera is odd beyond 0.15 and three times what others do."""
    said = of_peers(monkeypatch, ball, [usual] * 3 + [own] + [usual] * 4, [0.0] * 8)
    assert len(said) == found
    if found:
        [(text, left_out)] = said
        assert f"'c3': {100 * own:.0f} % of its mask" in text
        assert left_out == ("c3" if own > 0.3 else None) and ("is left out" in text) == (own > 0.3)


@pytest.mark.parametrize(
    ("usual", "own", "found"), [(0.02, 0.033, False), (0.02, 0.035, True), (0.0, 0.005, True), (-0.02, 0.005, True)]
)
def test_masks_that_take_away_are_judged_beside_what_is_usual(monkeypatch, ball, usual, own, found):
    said = of_peers(monkeypatch, ball, [0.0] * 8, [usual] * 5 + [own] + [usual] * 2)
    assert len(said) == found and all("'c5' alone takes" in text and camera is None for text, camera in said)


@pytest.mark.parametrize("count", [1, 3, 4, 8])
def test_half_of_all_masks_inverted_is_one_finding_for_all(ball, count):
    mask = ball.mask.clone()
    mask[:count] = 255 - mask[:count]
    found = faulty_masks(replace(ball, mask=mask), ball.cameras.names, None)
    if count < 4:
        assert [f.camera for f in found] == list(ball.cameras.names[:count]) and not any(f.fatal for f in found)
    else:
        assert len(found) == 1 and found[0].fatal and f"in {count} of 8 cameras" in found[0].text


def test_a_camera_that_hardly_shows_the_subject_does_not_decide_whether_a_rig_agrees(monkeypatch, ball):
    """Its few pixels agree with nothing; one that shows all of the subject does decide."""
    iou = torch.tensor([0.95] * 7 + [0.2])
    monkeypatch.setattr(diagnosis, "silhouette_iou", lambda covered, mask: iou)
    assert diagnosis._agreement(ball, ball.cameras, None)[0] == pytest.approx(0.2)
    wide = replace(ball.cameras, K=ball.cameras.K.clone())
    wide.K[7, [0, 1], [0, 1]] /= 3  # its subject is a ninth of the others'
    assert diagnosis._agreement(photograph(wide), wide, None)[0] == pytest.approx(float(iou.mean()))
