"""The quick part of the page's tests: it comes up, and its small modules keep their laws."""

import numpy as np
import pytest
from live.browser import scene
from live.browser.conftest import opened
from live.browser.stand_in import StandIn, depth_part


@pytest.fixture(scope="module")
def page(browser):
    with StandIn() as server, opened(browser, server) as view:
        view.settle()
        yield view


def call(page, module: str, body: str, argument: object = None):
    """Run a function's body with a module of the page as `m` and `x`."""
    return page.page.evaluate(f"async x => {{ const m = await import('/page/{module}'); {body} }}", argument)


def test_it_shows_a_picture_and_says_what_it_understands(page):
    assert page.server.hellos[0]["version"] == 1
    assert page.server.hellos[0]["codecs"][0] == "jpeg"
    assert page.page.locator("#source").inner_text() == "two balls"
    assert page.page.locator("#cover").is_hidden()
    assert (page.picture().max(-1) > 60).mean() > 0.03


def test_every_control_has_a_name(page):
    nameless = page.page.evaluate(
        "[...document.querySelectorAll('button, input, select, [role=slider], [role=img], canvas')]"
        ".filter(e => ![e.textContent, e.ariaLabel, e.closest('label')?.textContent].some(t => t?.trim()))"
        ".map(e => e.outerHTML)"
    )
    assert nameless == []


def test_all_comes_from_this_server(page):
    names = page.page.evaluate("performance.getEntriesByType('resource').map(e => e.name)")
    assert names
    assert all(name.startswith(page.server.url) for name in names)


def test_a_pose_is_what_the_protocol_says(page):
    pose = {"target": [0.1, 0.9, 0.2], "azimuth": 50, "elevation": 20, "roll": 0, "distance": 2.5, "fov": 40}
    rig = scene.rig()
    got = call(page, "view/pose.js", "return m.extrinsicsFromPose(x[0], x[1])", [rig, pose])
    a, e = np.deg2rad([50, 20])
    eye = np.array(pose["target"]) + 2.5 * np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    forward = (np.array(pose["target"]) - eye) / 2.5
    right = np.cross(forward, [0, 1, 0]) / np.linalg.norm(np.cross(forward, [0, 1, 0]))
    R = np.stack([right, np.cross(forward, right), forward])
    np.testing.assert_allclose(np.reshape(got["R"], (3, 3)), R, atol=1e-9)
    np.testing.assert_allclose(got["T"], -R @ eye, atol=1e-9)


@pytest.mark.parametrize("roll", [0, -70, 170])
def test_the_pose_of_a_camera_is_that_camera(page, roll):
    pose = {
        "target": scene.CENTER.tolist(),
        "azimuth": 200,
        "elevation": -35,
        "roll": roll,
        "distance": 3,
        "fov": 40,
    }
    body = """const [rig, pose] = x, c = m.extrinsicsFromPose(rig, pose);
              return [c, m.extrinsicsFromPose(rig, m.poseFromCamera(rig, c, rig.center, 40))]"""
    there, back = call(page, "view/pose.js", body, [scene.rig(), pose])
    np.testing.assert_allclose(back["R"], there["R"], atol=1e-9)
    np.testing.assert_allclose(back["T"], there["T"], atol=1e-9)


def test_depth_is_unpacked(page, rng):
    z = np.random.default_rng(0).uniform(1, 5, (21, 30))
    z[3:9, 4:20] = 0
    about, content = depth_part(z, 4)
    body = """const d = await m.decodeDepth({about: x[0], bytes: new Uint8Array(x[1])});
              return [d.width, d.height, [...d.z]]"""
    width, height, got = call(page, "link/frames.js", body, [about, list(content)])
    rows, columns = np.minimum(np.arange(0, 21, 4) + 2, 20), np.minimum(np.arange(0, 30, 4) + 2, 29)
    expected = z[rows][:, columns]
    np.testing.assert_allclose(np.reshape(got, (height, width)), expected, rtol=1e-3)
    assert (np.reshape(got, (height, width)) == 0).sum() == (expected == 0).sum() > 0


def test_the_size_asked_for_keeps_the_shape_and_the_limits(page):
    def size(width: int, height: int, side: int, limits: dict) -> tuple[int, int]:
        box = {"left": 0, "top": 0, "width": width, "height": height}
        got = call(page, "view/lens.js", "return m.chooseSize(...x)", [box, side, limits])
        return got["width"], got["height"]

    wide = {"max_side_px": 4096, "max_pixels": 10**7}
    assert size(800, 800, 320, wide) == (320, 320)
    width, height = size(1280, 800, 320, wide)
    assert abs(width / height - 1.6) < 0.03
    assert abs(width * height - 320**2) < 0.04 * 320**2
    assert max(size(1280, 200, 1024, wide | {"max_side_px": 1000})) <= 1000
    width, height = size(1280, 800, 1024, wide | {"max_pixels": 90_000})
    assert width * height <= 90_000


def test_a_track_passes_its_views_and_takes_the_short_way_round(page):
    pose = {"target": [0, 1, 0], "azimuth": 350, "elevation": 5, "roll": 0, "distance": 3, "fov": 45}
    poses = [pose, pose | {"azimuth": 10, "distance": 2}, pose | {"azimuth": 40}]
    body = """const t = new m.Track(); for (const p of x) t.add(p, 7);
              return [t.at(0), t.at(2), t.at(4), t.at(1), t.moments.length, t.timeAt(3, 10, {first: 0, end: 20})]"""
    start, middle, end, between, count, time = call(page, "view/camera_path.js", body, poses)
    assert [start["azimuth"] % 360, middle["azimuth"] % 360, end["azimuth"] % 360] == pytest.approx(
        [350, 10, 40]
    )
    assert middle["distance"] == pytest.approx(2)
    assert -10 < (between["azimuth"] + 180) % 360 - 180 < 10
    assert count == 4 * 30 + 1
    assert time == (7 + 30) % 20


def test_a_track_through_high_views_does_not_tip_over(page):
    pose = {"target": [0, 1, 0], "azimuth": 0, "elevation": 0, "roll": 0, "distance": 3, "fov": 45}
    poses = [pose, pose | {"elevation": 89}, pose | {"elevation": 89, "azimuth": 40}]
    body = "const t = new m.Track(); for (const p of x) t.add(p, 7); return t.moments.map((s) => t.at(s).elevation)"
    assert max(call(page, "view/camera_path.js", body, poses)) <= 89


def test_a_surface_is_cut_at_jumps_in_depth_and_whole_elsewhere(page):
    z = np.full((6, 8), 3.0)
    z[:, 4:] = 4.0
    z[0] = 0
    depth = {"width": 8, "height": 6, "stride": 2, "z": z.ravel().tolist()}
    body = """const s = m.buildSurface({...x, z: Float32Array.from(x.z)}, 16, 12);
              return [[...s.vertices], [...s.solid], [...s.stretched]]"""
    vertices, solid, stretched = call(page, "draw/surface.js", body, depth)
    vertices = np.reshape(vertices, (-1, 5))
    triangles = vertices[np.reshape(solid, (-1, 3))]
    assert (triangles[..., 2] > 0).all()
    assert (triangles[..., 2].max(1) / triangles[..., 2].min(1) < 1.03).all()
    assert len(stretched) == 6 * 4  # the jump, one cell wide
    assert (vertices[stretched, 3] >= 9).all()  # in the farther surface's colours
    sides = triangles[:, 1:, :2] - triangles[:, :1, :2]
    area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).sum() / 2
    two_layers = 12 * 2.0  # cells across the jump are covered by both surfaces
    assert area == pytest.approx(16 * 12 + two_layers, rel=1e-6)
