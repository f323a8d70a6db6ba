"""HEIC images, as phones write them: read with pillow-heif, and named without it."""

import numpy as np
import pytest
from PIL import Image

from viewmend.cli import main
from viewmend.data import images
from viewmend.data.capture_folder import open_capture

pillow_heif = pytest.importorskip("pillow_heif", reason="an extra")


@pytest.fixture
def heic(plain):
    """The ball, with HEIC images."""
    for camera in plain.description["cameras"]:
        for frame in plain.description["frames"]:
            file = plain.path / camera["image"].replace("{frame}", frame)
            rgb = plain.get(str(file.relative_to(plain.path)))[..., ::-1]
            image = Image.fromarray(np.ascontiguousarray(rgb))
            pillow_heif.from_pillow(image).save(file.with_suffix(".heic"), quality=95)
            file.unlink()
        camera["image"] = camera["image"].replace(".png", ".heic")
    plain.save()
    return plain


def test_heic_images_open(heic):
    frame = open_capture(heic.path).read(0)
    assert frame.rgb.shape[0] == 4 and float(frame.rgb.float().std()) > 10
    data = next(heic.path.rglob("*.heic")).read_bytes()
    assert images.heif_size_px(data) == (40, 32)


def test_a_damaged_heic_image_is_one_line(heic, capsys):
    file = next(heic.path.rglob("*.heic"))
    file.write_bytes(file.read_bytes()[:200])
    assert main(["check", str(heic.path)]) == 2
    assert "that are not an image or are truncated" in capsys.readouterr().err


def test_heic_is_named_where_it_cannot_be_read(heic, monkeypatch, capsys):
    monkeypatch.setattr(images, "pillow_heif", None)
    assert main(["check", str(heic.path)]) == 2
    said = capsys.readouterr().err
    assert "got HEIC, which needs pillow-heif; install viewmend[heic], or convert" in said
