"""Cameras as ASCII USD."""

import json
import re
from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor

from viewmend.export.engine_cameras import SENSOR_MM, engine_from_cameras
from viewmend.geometry.cameras import Cameras


def usd_scene(groups: Mapping[str, Cameras], rotation: Float[Tensor, "3 3"], fps: float, frames: int) -> str:
    """Cameras as ASCII USD (.usda), metres, y up; skew is left out."""
    lines = ["#usda 1.0", "(", '    defaultPrim = "scene"', "    metersPerUnit = 1", '    upAxis = "Y"']
    lines += [
        f"    timeCodesPerSecond = {fps:g}",
        "    startTimeCode = 0",
        f"    endTimeCode = {frames - 1}",
        ")",
        "",
    ]
    lines += ['def Xform "scene"', "{"]
    for group, cameras in groups.items():
        lines += [f'    def Scope "{group}"', "    {"]
        names = _prim_names(cameras.names)
        for view, pose in enumerate(engine_from_cameras(cameras, rotation).double().mT.tolist()):
            lines += [f"        {line}" for line in _usd_camera(names[view], cameras[view], pose)]
        lines.append("    }")
    return "\n".join([*lines, "}", ""])


def _usd_camera(prim: str, camera: Cameras, pose: list[list[float]]) -> list[str]:
    """One camera; USD has lengths of its sensor in tenths of the scene's unit."""
    width, height = camera.size_px[0].tolist()
    K = camera.K[0].double()
    aperture = SENSOR_MM / 100
    per_x = aperture / width
    per_y = aperture / width * float(K[0, 0] / K[1, 1])
    rows = ", ".join(f"({', '.join(f'{value:.9g}' for value in row)})" for row in pose)
    values = {
        "focalLength": float(K[0, 0]) * per_x,
        "horizontalAperture": aperture,
        "verticalAperture": height * per_y,
        "horizontalApertureOffset": (width / 2 - float(K[0, 2])) * per_x,
        "verticalApertureOffset": (float(K[1, 2]) - height / 2) * per_y,
    }
    return [
        f'def Camera "{prim}" (displayName = {json.dumps(camera.names[0], ensure_ascii=False)})',
        "{",
        *(f"    float {name} = {value:.9g}" for name, value in values.items()),
        "    float2 clippingRange = (0.01, 1000)",
        f"    matrix4d xformOp:transform = ({rows})",
        '    uniform token[] xformOpOrder = ["xformOp:transform"]',
        "}",
    ]


def _prim_names(names: tuple[str, ...]) -> list[str]:
    """Unique identifiers that USD allows."""
    found: list[str] = []
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)
        if not plain or plain[0].isdigit():
            plain = f"camera_{plain}"
        unique = plain
        number = 1
        while unique in found:
            number += 1
            unique = f"{plain}_{number}"
        found.append(unique)
    return found
