import math

import pytest
import torch

from viewmend.data.errors import CaptureError
from viewmend.geometry.rigid import rotation_from_axis_angle
from viewmend.studio.bvh import read_bvh

TEXT = """HIERARCHY
ROOT a
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT b
  {
    OFFSET 0 1 0
    CHANNELS 3 Yrotation Zrotation Xrotation
    End Site
    {
      OFFSET 0 0 2
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.05
0 0 0 0 0 0 0 0 0
4 5 6 90 0 0 0 0 90
"""


def test_reads_hierarchy_and_rotations_by_hand(tmp_path):
    path = tmp_path / "two.bvh"
    path.write_text(TEXT)
    motion = read_bvh(path)
    assert motion.names == ("a", "b", "") and motion.parents == (-1, 0, 1)
    assert motion.seconds_per_frame == 0.05
    assert motion.rest.tolist() == [[0, 0, 0], [0, 1, 0], [0, 1, 2]]
    assert motion.root.tolist() == [[0, 0, 0], [4, 5, 6]]
    quarter_z = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    quarter_x = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    torch.testing.assert_close(motion.rotations[1, 0], quarter_z, atol=1e-6, rtol=0)
    torch.testing.assert_close(motion.rotations[1, 1], quarter_z @ quarter_x, atol=1e-6, rtol=0)
    torch.testing.assert_close(motion.rotations[0], torch.eye(3).expand(3, 3, 3))


def test_channels_multiply_in_their_order(tmp_path):
    path = tmp_path / "two.bvh"
    path.write_text(TEXT.replace("90 0 0 0 0 90", "30 40 50 0 0 0"))
    axes = torch.eye(3, dtype=torch.float64)
    z, x, y = (rotation_from_axis_angle(axes[a] * math.radians(d)) for a, d in ((2, 30), (0, 40), (1, 50)))
    torch.testing.assert_close(read_bvh(path).rotations[1, 0], (z @ x @ y).float(), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.replace("Frames: 2", "Frames: 3"), "expected 3 frames of 9"),
        (lambda s: s.replace("4 5 6", "4 nan 6"), "finite"),
        (lambda s: s.replace("MOTION", ""), "HIERARCHY and MOTION"),
        (lambda s: s.replace("OFFSET 0 1 0", "OFFSET 0 x 0"), "breaks off"),
        (lambda s: s.replace("Frame Time: 0.05", "Frame Time: 0"), "positive frame time"),
        (lambda s: s.replace("4 5 6", "4 five 6"), "numbers"),
    ],
)
def test_bad_files_say_what_is_wrong(tmp_path, change, message):
    path = tmp_path / "bad.bvh"
    path.write_text(change(TEXT))
    with pytest.raises(CaptureError, match=message) as caught:
        read_bvh(path)
    assert "bad.bvh" in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CaptureError, match=r"none\.bvh"):
        read_bvh(tmp_path / "none.bvh")
