"""Writers of calibrations whose every image is a camera, from the formats' own descriptions, for round trips."""

import numpy as np
from scipy.spatial.transform import Rotation


def write_middlebury(file, cameras):
    """A `*_par.txt`, whose images lie in `images`."""
    lines = [str(len(cameras))]
    for camera in cameras:
        numbers = [*camera["K"].ravel(), *camera["R"].ravel(), *camera["t"]]
        lines.append(" ".join([camera["image"].removeprefix("images/"), *(repr(float(n)) for n in numbers)]))
    file.write_text("\n".join(lines) + "\n")


def write_agisoft(file, cameras, old=False, moved=None):
    """Metashape's XML. `moved` is a seed of the chunk's own place and scale; its images have labels without a suffix.

    The file also has a photo that is disabled, one that is not aligned, and what the lens was thought to be at first.
    """
    turn, shift, scale = np.eye(3), np.zeros(3), 1.0
    if moved is not None:
        turn, shift, scale = Rotation.random(random_state=moved).as_matrix(), np.array([3.0, -4, 5]), 2.5
    sensors, photos = [], ['<camera id="900" sensor_id="0" label="unaligned"/>']
    for index, camera in enumerate(cameras):
        K, (k1, k2, p1, p2, k3) = camera["K"], camera["dist"]
        if old:
            values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "skew": K[0, 1]}
        else:
            values = {"f": K[1, 1], "b1": K[0, 0] - K[1, 1], "b2": K[0, 1]}
            values |= {"cx": K[0, 2] - camera["width"] / 2, "cy": K[1, 2] - camera["height"] / 2}
        values |= {"k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1}
        size = f'<resolution width="{camera["width"]}" height="{camera["height"]}"/>'
        lens = size + "".join(f"<{key}>{float(value)!r}</{key}>" for key, value in values.items())
        sensors.append(
            f'<sensor id="{index}" type="frame">{size}<calibration type="frame" class="initial">{size}<f>9</f>'
            f'</calibration><calibration type="frame" class="adjusted">{lens}</calibration></sensor>'
        )
        rotation = turn.T @ camera["R"].T  # chunk_from_camera
        centre = turn.T @ (-camera["R"].T @ camera["t"] - shift) / scale
        pose = np.vstack([np.c_[rotation, centre], [0, 0, 0, 1]])
        photo = f"<transform>{_numbers(pose)}</transform></camera>"
        label = camera["image"].removeprefix("images/").removesuffix(".png")
        photos.append(f'<camera id="{index}" sensor_id="{index}" label="{label}" enabled="true">{photo}')
    photos.append(photos[-1].replace('enabled="true"', 'enabled="false"').replace('label="', 'label="off'))
    place = f"<rotation>{_numbers(turn)}</rotation><translation>{_numbers(shift)}</translation><scale>{scale}</scale>"
    parts = [
        f"<sensors>{''.join(sensors)}</sensors>",
        f'<cameras><group id="0">{"".join(photos)}</group></cameras>',
    ]
    parts += [f"<transform>{place if moved is not None else ''}</transform>"]
    file.write_text(
        f'<?xml version="1.0"?>\n<document version="1.4.0"><chunk label="1">{"".join(parts)}</chunk></document>'
    )


def _numbers(array):
    return " ".join(repr(float(n)) for n in array.ravel())
