import numpy as np
import torch

from viewmend.utils.contact_sheet import BACKGROUND, GAP_PX, LABEL_PX, Tile, contact_sheet, picture


def test_tiles_land_in_their_boxes_with_their_aspect_kept():
    wide = Tile("wide", np.full((50, 100, 3), 255, np.uint8))
    tall = Tile("", np.full((100, 50, 3), 200, np.uint8))
    sheet = contact_sheet([[wide, tall], [Tile("", None)]], tile_width=80)
    assert sheet.shape == (2 * (160 + LABEL_PX + GAP_PX) + GAP_PX, 2 * 84 + GAP_PX, 3)
    top = GAP_PX + LABEL_PX
    assert (sheet[top : top + 40, GAP_PX : GAP_PX + 80] == 255).all()
    assert (sheet[top + 40 : top + 160, GAP_PX : GAP_PX + 80] == BACKGROUND).all()
    assert (sheet[top : top + 160, GAP_PX + 84 : GAP_PX + 164] == 200).all()
    assert sheet[GAP_PX:top, GAP_PX : GAP_PX + 80].max() > 150  # the caption
    assert (sheet[top + 170 :] == BACKGROUND).all()


def test_pictures_from_floats_bytes_and_masks():
    rgb = torch.tensor([0.0, 0.5, 2.0]).view(3, 1, 1).expand(3, 2, 4)
    assert picture(rgb)[1, 3].tolist() == [0, 128, 255]
    assert picture((rgb.clamp(0, 1) * 255).round().byte())[1, 3].tolist() == [0, 128, 255]
    assert picture(torch.ones(1, 2, 4)).shape == (2, 4, 3)
