import cv2
import numpy as np
import pytest
import torch

from viewmend.capture.plain import open_capture

BARREL, PINCUSHION = [-0.5, 0.1, 0.02, -0.01, -0.02], [0.5, 0.1, -0.02, 0.01, 0.1]


def distorted(K: np.ndarray, dist: list[float], scene) -> np.ndarray:
    """What a camera with this lens takes of `scene`, a function of normalised image coordinates."""
    v, u = np.mgrid[:32, :40].astype(np.float64)
    x, y = (u + 0.5 - K[0, 2]) / K[0, 0], (v + 0.5 - K[1, 2]) / K[1, 1]
    undistorted = np.stack([x, y], -1)
    for _ in range(100):  # invert the forward model by fixed point
        x_u, y_u = undistorted[..., 0], undistorted[..., 1]
        r2 = x_u**2 + y_u**2
        radial = 1 + dist[0] * r2 + dist[1] * r2**2 + dist[4] * r2**3
        dx = 2 * dist[2] * x_u * y_u + dist[3] * (r2 + 2 * x_u**2)
        dy = dist[2] * (r2 + 2 * y_u**2) + 2 * dist[3] * x_u * y_u
        undistorted = np.stack([(x - dx) / radial, (y - dy) / radial], -1)
    return scene(undistorted[..., 0], undistorted[..., 1])


def waves(x, y):
    return np.uint8(128 + 60 * np.sin(9 * x) + 60 * np.sin(11 * y + 1))


@pytest.mark.parametrize("dist", [BARREL, PINCUSHION])
@pytest.mark.parametrize("first", [0.5, 0.0])
def test_images_and_masks_become_those_of_the_pinhole(plain, dist, first):
    K = np.array(plain.description["cameras"][0]["K"])
    image = distorted(K, dist, waves)
    plain.put("images/lens.png", np.dstack([image] * 3))
    plain.put("masks/lens.png", image)
    shifted = (K - [[0, 0, 0.5 - first], [0, 0, 0.5 - first], [0, 0, 0]]).tolist()
    plain.edit(lambda d: d.update(first_pixel_center=[first, first]))
    plain.edit(lambda d: d["cameras"][0].update(dist=dist, image="images/lens.png", mask="masks/lens.png", K=shifted))
    frame = open_capture(plain.path).read(0)
    truth = torch.from_numpy(distorted(K, [0.0] * 5, waves)).float()
    inside = slice(4, -4), slice(4, -4)  # a pincushion lens did not take the corners
    assert (frame.rgb[0].float() - truth)[:, *inside].abs().mean() < 0.6
    assert (frame.mask[0].float() - truth)[inside].abs().mean() < 0.6
    assert (torch.from_numpy(image).float() - truth)[inside].abs().mean() > 3  # there was something to straighten


def test_beyond_the_image_taken_the_border_goes_on(plain):
    K = np.array(plain.description["cameras"][0]["K"])
    plain.put("masks/lens.png", np.full((32, 40), 255, np.uint8))
    plain.edit(lambda d: d["cameras"][0].update(dist=[1.5, 0, 0, 0, 0], mask="masks/lens.png"))
    plain.edit(lambda d: [camera.update(depth="depth/lens.png") for camera in d["cameras"]])
    plain.put("depth/lens.png", np.full((32, 40), 2000, np.uint16))
    frame = open_capture(plain.path).read(0)
    assert (frame.mask[0] == 255).all()  # unknown there: it must carve nothing
    assert frame.depth[0, 0, 0] == 0 and abs(float(frame.depth[0, 16, 20]) - 2) < 1e-6
    assert float(frame.cameras.K[0, 0, 0]) == pytest.approx(K[0, 0])


def test_depths_are_not_mixed_across_an_edge(plain):
    depth = np.full((32, 40), 1000, np.uint16)
    depth[:, 21:] = 3000
    plain.put("depth/edge.png", depth)
    plain.edit(lambda d: [camera.update(depth="depth/edge.png", dist=BARREL) for camera in d["cameras"]])
    assert set(open_capture(plain.path).read(0).depth[0].unique().tolist()) <= {0.0, 1.0, 3.0}


def test_opencv_agrees(plain):
    K = np.array(plain.description["cameras"][0]["K"])
    plain.edit(lambda d: d["cameras"][0].update(dist=BARREL))
    K_opencv = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    expected = cv2.undistort(plain.get("images/a_000.png"), K_opencv, np.array(BARREL))[..., ::-1].copy()
    frame = open_capture(plain.path).read(0)
    difference = frame.rgb[0].float() - torch.from_numpy(expected).permute(2, 0, 1).float()
    assert difference[:, 2:-2, 2:-2].abs().mean() < 3
