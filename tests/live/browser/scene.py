"""Two textured balls on black, ray by ray: pictures and depth that depend on pose, mode and time alone."""

import numpy as np

CENTER = np.array([0.0, 1.0, 0.0])
BIG, SMALL = 0.5, 0.2
CAMERAS = 4
COLOURS = [[230, 120, 60], [70, 150, 230]]
SOURCES = ["cam00", "cam01"]
INPUTS = ["cam00", "cam01", "cam02"]
PINK = (255, 38, 140)
CLAY = (219, 212, 201)
FRAMES = 40


def look_at(eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    forward = (CENTER - eye) / np.linalg.norm(CENTER - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return R, -R @ eye


def rig() -> dict:
    """The rig message: a ring of cameras, azimuth 0 at +z, 90 at +x."""
    cameras = []
    for n in range(CAMERAS):
        angle = 2 * np.pi * n / CAMERAS + 0.4
        eye = CENTER + 3 * np.array([np.sin(angle), 0.15, np.cos(angle)])
        R, T = look_at(eye)
        K = [400.0, 0, 160, 0, 400, 120, 0, 0, 1]
        lens = {"name": f"cam{n:02}", "width": 320, "height": 240, "K": K}
        cameras.append({**lens, "R": R.ravel().tolist(), "T": T.tolist(), "center": eye.tolist()})
    return {
        "type": "rig",
        "name": "two balls",
        "cameras": cameras,
        "bounds": {"low": [-1, 0, -1], "high": [1, 2, 1]},
        "center": CENTER.tolist(),
        "up": [0, 1, 0],
        "front": [0, 0, 1],
        "side": [1, 0, 0],
        "home": {"azimuth": 20, "elevation": 10, "distance": 3.0, "fov_y": 45},
        "fps": 10,
    }


def _hit(origin: np.ndarray, rays: np.ndarray, middle: np.ndarray, radius: float) -> np.ndarray:
    """How many rays' lengths away the ball is, inf where it is missed; `rays` (..., 3)."""
    to = origin - middle
    a, b, c = (rays**2).sum(-1), 2 * rays @ to, to @ to - radius**2
    inside = b * b - 4 * a * c
    with np.errstate(invalid="ignore"):
        distance = (-b - np.sqrt(inside)) / (2 * a)
    return np.where((inside > 0) & (distance > 0), distance, np.inf)


def render(camera: dict, width: int, height: int, time: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGB (height, width, 3), z-depth (0: none), and which surface points (height, width, 3) are seen."""
    R, T = np.reshape(camera["R"], (3, 3)), np.array(camera["T"])
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = np.stack(
        [(u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"], np.ones_like(u)], -1
    )
    rays, origin = local @ R, -R.T @ T
    small = CENTER + np.array([0.75 * np.cos(0.3 * time), 0.3, 0.75 * np.sin(0.3 * time)])
    hits = np.stack([_hit(origin, rays, CENTER, BIG), _hit(origin, rays, small, SMALL)])
    z = hits.min(0)  # rays have z = 1 in the camera
    seen = np.isfinite(z)
    points = origin + rays * np.where(seen, z, 0)[..., None]
    normal = (points - np.where((hits[0] <= hits[1])[..., None], CENTER, small)) * 6
    checks = (np.floor(normal).astype(int).sum(-1) & 1).astype(bool)
    rgb = np.where(checks[..., None], (210, 170, 130), (60, 90, 150))
    rgb = np.where((hits[1] < hits[0])[..., None], rgb[..., ::-1], rgb)
    return np.where(seen[..., None], rgb, 0).astype(np.uint8), np.where(seen, z, 0), points


def picture(rgb: np.ndarray, z: np.ndarray, points: np.ndarray, mode: str) -> np.ndarray:
    """One of the protocol's modes; the holes are a band of the surface."""
    seen = z > 0
    hole = seen & (np.abs(points[..., 1] - CENTER[1]) < 0.12)
    if mode == "depth":
        return np.repeat(np.where(seen, np.clip(255 - 50 * z, 30, 255), 0)[..., None], 3, -1).astype(np.uint8)
    if mode == "coverage":
        return np.where(seen[..., None], np.where(points[..., :1] > 0, COLOURS[0], COLOURS[1]), 0).astype(
            np.uint8
        )
    if mode == "confidence":
        return np.where(seen[..., None], (253, 231, 36), 0).astype(np.uint8)
    if mode in ("hull", "points"):
        dots = (np.indices(z.shape) % 3 == 0).all(0)
        return np.where((seen & (dots | (mode == "hull")))[..., None], CLAY, 0).astype(np.uint8)
    fill = {"completed": rgb, "rendered": np.zeros_like(rgb), "holes": np.full_like(rgb, PINK)}[mode]
    return np.where(hole[..., None], fill, rgb).astype(np.uint8)


def original(name: str, time: int) -> np.ndarray:
    """What a camera of the rig took: the scene before a green wall."""
    camera = next(one for one in rig()["cameras"] if one["name"] == name)
    fx, _, cx, _, fy, cy = camera["K"][:6]
    lens = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    rgb, z, _ = render({**camera, **lens}, camera["width"], camera["height"], time)
    return np.where((z > 0)[..., None], rgb, (20, 160, 60)).astype(np.uint8)


def hole_share(z: np.ndarray, points: np.ndarray) -> float:
    seen = z > 0
    return float((seen & (np.abs(points[..., 1] - CENTER[1]) < 0.12)).sum() / max(1, seen.sum()))
