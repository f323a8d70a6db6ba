"""True correspondences: where cameras saw what a view misses; windows keep them, and attention is taught by them."""

from dataclasses import replace

import pytest
import torch
from training.conftest import PLAN, RUN
from training.test_windows import SEARCH_PX, SIDE_PX, middle, offset_px

from viewmend.inpainting import patch_transformer, transformer
from viewmend.inpainting.attention import attend
from viewmend.inpainting.chain import build
from viewmend.inpainting.config import paper_small
from viewmend.inpainting.context import ContextFrame
from viewmend.inpainting.correspondences import AttentionGuide, Correspondences, sought_keys
from viewmend.leave_one_out import true_visibility
from viewmend.leave_one_out.true_visibility import TrueSurface, surface_seen, true_correspondences
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.loop import Run
from viewmend.training.objective import Objective
from viewmend.training.plan import LossWeights, Recipe
from viewmend.training.processes import Processes
from viewmend.training.sample_files import sample_from_bytes, sample_to_bytes, write_shards
from viewmend.training.samples import Sample
from viewmend.training.scenes import StudioScenes
from viewmend.training.windows import window

MODEL = replace(paper_small(), widths=(8,) * 9, dim=32, heads=2, groups=2, blocks=2, top_k=None)
TIMES = (5, 0)


@pytest.fixture(scope="module")
def whole() -> Sample:
    """A view of 288 x 288 pixels by cameras without a fault, with some past."""
    plan = replace(PLAN, sizes_px=(288,), held_cameras=1, context_cameras=(3,), context_weights=(1,), least_past=1)
    plan = replace(plan, times=tuple(sorted(TIMES)), past=(1,), imperfect_fraction=0.0, ray_views=0, matches=True)
    return StudioScenes(plan, "windows").scene(0)[0]


@pytest.fixture(scope="module")
def cut(whole) -> Sample:
    return window(whole, middle(whole), SIDE_PX, SEARCH_PX)


def test_a_match_shows_the_same_surface_now_and_before(whole):
    matches = whole.matches
    frames = {views.frame.time: views.frame for views in whole.context}
    assert set(matches.time.tolist()) == set(TIMES) and set(matches.camera.tolist()) == {0, 1, 2}
    for time in TIMES:
        own = matches.select(matches.time == time)
        place = [frames[time].cameras.names.index(own.names[c]) for c in own.camera.tolist()]
        column, row = own.uv_px.long().unbind(1)
        seen = frames[time].rgb[place, :, row, column].float()
        wanted = whole.truth[:, own.pixels[:, 0], own.pixels[:, 1]].T.float()
        off, beside = (seen - wanted).abs().mean(1), (seen - wanted.roll(7, 0)).abs().mean(1)
        assert off.median() < 0.6 * beside.median() and off.median() < 20, time
    assert bool((whole.view.error[tuple(matches.pixels.unbind(1))] > 0).all()), "of what is missing alone"


@pytest.mark.parametrize("most", [10_000, 40])
def test_matches_are_what_the_cameras_see_of_the_surface(most, monkeypatch):
    monkeypatch.setattr(true_visibility, "MOST_PIXELS", most)
    studio = Studio(StudioConfig(seed=4, cameras=5, frames=6, size_px=96))
    target, others = studio.true_cameras.select(["cam00"]), ("cam02", "cam01", "cam04")
    meshes = {t: studio.scene(t).mesh for t in TIMES}
    surfaces = {t: TrueSurface.of(studio.read(t).select(others), meshes[t]) for t in TIMES}
    missing = torch.zeros(96, 96, dtype=torch.bool)
    missing[20:70:2, 30:60] = True
    matches = true_correspondences(surfaces, meshes[5], target, missing)
    seen = surface_seen(surfaces, TIMES, meshes[5], target).seen
    found = torch.zeros_like(seen)
    where = torch.tensor([TIMES.index(t) for t in matches.time.tolist()])
    found[where, matches.camera, matches.pixels[:, 0], matches.pixels[:, 1]] = True
    asked = found.any(0).any(0)
    assert matches.names == others and len(matches.pixels) == int(found.sum()) > 20
    assert torch.equal(found, seen & asked) and not bool((asked & ~missing).any())
    shown = missing & seen.any(0).any(0)
    assert torch.equal(asked, shown) if most == 10_000 else 20 < int(asked.sum()) < 90


def test_a_window_keeps_the_matches_that_it_shows(whole, cut):
    def absolute(sample: Sample) -> dict[tuple[int, ...], tuple[float, float]]:
        at = offset_px(sample.view.camera, whole.view.camera)
        found = {}
        for n, (row, column) in enumerate(sample.matches.pixels.tolist()):
            time, name = int(sample.matches.time[n]), sample.matches.names[int(sample.matches.camera[n])]
            own, before = (
                next(v.frame.cameras for v in s.context if v.frame.time == time).select([name]) for s in (sample, whole)
            )
            top, left = offset_px(own, before)
            u, v = sample.matches.uv_px[n].tolist()
            assert 0 <= u < int(own.size_px[0, 0]) and 0 <= v < int(own.size_px[0, 1]), "in the image that is there"
            found[row + at[0], column + at[1], time, name] = (u + left, v + top)
        return found

    before, kept = absolute(whole), absolute(cut)
    assert 20 < len(kept) < len(before)
    for key, uv in kept.items():
        assert uv == pytest.approx(before[key], abs=1e-3)
    at, inner = offset_px(cut.view.camera, whole.view.camera), cut.view.part.inner[0]
    for key in before.keys() - kept.keys():
        row, column = key[0] - at[0], key[1] - at[1]
        within = 0 <= row < inner.shape[0] and 0 <= column < inner.shape[1] and bool(inner[row, column])
        then = next(v.frame.cameras for v in cut.context if v.frame.time == key[2])
        if within and key[3] in then.names:
            part, whole_one = then.select([key[3]]), next(v for v in whole.context if v.frame.time == key[2])
            top, left = offset_px(part, whole_one.frame.cameras.select([key[3]]))
            u, v = before[key][0] - left, before[key][1] - top
            assert not (0 <= u < int(part.size_px[0, 0]) and 0 <= v < int(part.size_px[0, 1])), key
    again = sample_from_bytes(sample_to_bytes(cut))
    assert torch.equal(again.matches.uv_px, cut.matches.uv_px) and again.matches.names == cut.matches.names


def frame(name: str, time: int, places: list[tuple[int, int]], template: ContextFrame) -> ContextFrame:
    own = slice(len(places))
    parts = {n: getattr(template, n)[own] for n in ("uv_px", "points_world", "valid", "tokens")}
    parts |= {"keys_values": template.keys_values[:, :, own], "places": torch.tensor(places)}
    return replace(template, camera=replace(template.camera, names=(name,)), time=time, **parts)


def test_sought_keys_equal_the_loops(cut):
    net = build(MODEL).eval()
    template = net.encode_contexts(cut.context)[0][0]
    rng = torch.Generator().manual_seed(3)
    grid = [(row, column) for row in range(4) for column in range(5)]
    frames = [frame("a", 7, grid, template), frame("b", 7, grid[::3], template), frame("a", 3, grid[::-1], template)]
    frames.append(frame("unknown", 7, grid, template))
    count = 60
    matches = Correspondences(
        ("b", "a"),
        torch.randint(0, 100, (count, 2), generator=rng),
        torch.randint(0, 2, (count,), generator=rng),
        torch.tensor([7, 3])[torch.randint(0, 2, (count,), generator=rng)],
        100 * torch.rand(count, 2, generator=rng),
    )
    queries = torch.tensor([(0, row, column) for row in range(6) for column in range(6) if (row + column) % 3])
    wanted = torch.zeros(len(queries), sum(len(f.places) for f in frames), dtype=torch.bool)
    for n in range(count):
        row, column = (matches.pixels[n] + 0.5).tolist()
        u, v = matches.uv_px[n].tolist()
        for q, (_, qr, qc) in enumerate(queries.tolist()):
            if abs(row - (16 * qr + 14)) >= 8 or abs(column - (16 * qc + 14)) >= 8:
                continue
            key = 0
            for f in frames:
                for pr, pc in f.places.tolist():
                    same = f.name == matches.names[int(matches.camera[n])] and f.time == int(matches.time[n])
                    wanted[q, key] |= same and abs(u - (16 * pc + 14)) < 14 and abs(v - (16 * pr + 14)) < 14
                    key += 1
    assert torch.equal(sought_keys(matches, queries, frames), wanted) and 10 < int(wanted.sum()) < wanted.numel() / 4
    assert sought_keys(matches, queries, []).shape == (len(queries), 0)


def test_the_guide_measures_what_attention_misses():
    rng = torch.Generator().manual_seed(1)
    Q, K = torch.randn(3, 2, 4, 6, generator=rng), torch.randn(3, 2, 5, 6, generator=rng)
    present = torch.tensor([[1, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 0, 0, 0, 0]], dtype=torch.bool)
    sought = torch.rand(3, 4, 5, generator=rng) > 0.6
    sought[1] = False
    sought[0, 2] = False
    guide = AttentionGuide(sought)
    guide.look(Q, K, present, 0.7)
    weights = attend(Q, K, torch.eye(5, 6).expand(3, 2, 5, 6), present, 0.7)[0, ..., :5]
    there = sought[0] & present[0]
    costs = [-torch.log(weights[:, q, there[q]].sum(1).mean()) for q in range(4) if there[q].any()]
    assert 1 < len(costs) < 4
    torch.testing.assert_close(guide.missed[0], torch.stack(costs).mean())
    assert guide.missed[1:] == [None, None], "nothing is sought; nothing is there"


def test_the_guide_sees_what_the_last_groups_first_block_looks_at(cut, monkeypatch):
    seen, net = [], build(MODEL)

    def recorded(Q, K, V, present, scale):
        seen.append((Q.detach(), K.detach(), present, scale))
        return attend(Q, K, V, present, scale)

    monkeypatch.setattr(transformer, "attend", recorded)
    monkeypatch.setattr(
        patch_transformer, "AttentionGuide", lambda sought: guides.append(AttentionGuide(sought)) or guides[-1]
    )
    guides = []
    made = net([cut.view], [list(cut.context)], matches=[cut.matches])[0]
    again = AttentionGuide(guides[0].sought)
    again.look(*(seen[2][n] for n in (0, 1, 2, 3)))
    assert len(seen) == 4 and len(guides) == 1 and guides[0].sought.any()
    torch.testing.assert_close(made.missed.detach(), again.missed[0])
    assert net([cut.view], [list(cut.context)])[0].missed is None


def recipe(**changes) -> Recipe:
    loss = LossWeights(**({"attention": 1.0} | changes))
    return Recipe(name="taught", model=MODEL, data=replace(PLAN, ray_views=0), loss=loss, **RUN, validate_every=0)


def test_attention_learns_where_the_surface_is_and_its_weight_falls(cut):
    torch.manual_seed(0)
    objective = Objective(build(MODEL), recipe(image=0.0))
    optimizer = torch.optim.Adam(objective.parameters(), 3e-3)
    first = float(objective([cut]).total.detach())
    for _ in range(25):
        optimizer.zero_grad()
        objective([cut]).total.backward()
        optimizer.step()
    with torch.no_grad():
        last = float(objective([cut]).total)
        assert last < first - 0.7
        objective.progress = 0.75
        assert float(objective([cut]).total) == pytest.approx(last / 4, rel=1e-3)
        plain = Objective(objective.model, recipe(attention=0.0))([cut])
        taught = Objective(objective.model, recipe())([cut])
        assert float(taught.total) == pytest.approx(float(plain.total) + last, rel=1e-4)
        assert torch.equal(taught.completed[0], plain.completed[0])
    with pytest.raises(ValueError, match=r"say where .* --matches"):
        objective([replace(cut, matches=None)])


def test_a_run_tells_how_much_of_it_is_over(cut, tmp_path):
    list(write_shards([cut] * 3, tmp_path / "shards"))
    plan = replace(PLAN, shards=tmp_path / "shards", ray_views=0)
    run = Run(replace(recipe(), data=plan), tmp_path / "run", None, Processes(0, 1, torch.device("cpu")))
    assert [run.objective.progress for _ in run.steps()] == [0.0, 0.25, 0.5, 0.75]
    assert "holes (section 8), 1 x attention;" in (tmp_path / "run" / "README.md").read_text()
