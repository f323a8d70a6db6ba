"""What is kept for long has memory of its own, and is the same; smallest and largest numbers."""

import gc
import re
from pathlib import Path

import pytest
import torch

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.proxy import GeometryProxy
from viewmend.utils.tensors import LARGE_BYTES, extremes, to_mmap


def proxy(vertices: int) -> GeometryProxy:
    mesh = Mesh(torch.rand(vertices, 3), torch.randint(0, vertices, (2 * vertices, 3), dtype=torch.int32))
    return GeometryProxy(mesh, torch.rand(vertices, 3), Bounds(torch.zeros(3), torch.ones(3)))


def test_the_same_values_in_another_place():
    before = proxy(10_000)
    after = to_mmap(before)
    pairs = [(before.mesh.vertices, after.mesh.vertices), (before.mesh.faces, after.mesh.faces)]
    for old, new in [*pairs, (before.normals, after.normals)]:
        assert torch.equal(old, new) and old.dtype == new.dtype and old.data_ptr() != new.data_ptr()
    assert after.bounds is before.bounds, "small things stay"


def test_what_is_small_is_no_copy():
    small = proxy(10)
    assert to_mmap(small).mesh.vertices is small.mesh.vertices and to_mmap(small).normals is small.normals
    assert to_mmap("name") == "name" and to_mmap(None) is None


@pytest.mark.parametrize(
    "of", [torch.uint8, torch.bool, torch.int32, torch.float16, torch.bfloat16, torch.float64]
)
def test_types_and_strides(of):
    wide = torch.randint(0, 2, (2, 300, 500)).to(of)
    part = wide[:, 7:300:2, 3:].transpose(1, 2)
    assert part.numel() * part.element_size() > LARGE_BYTES
    assert torch.equal(to_mmap(part), part) and to_mmap(part).dtype == of and to_mmap(part).is_contiguous()


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="needs /proc")
def test_its_pages_go_with_it():
    def mapped_mb() -> float:
        found = re.search(r"VmData:\s+(\d+)", Path("/proc/self/status").read_text())
        return int(found[1]) / 1024 if found else 0.0

    source = torch.ones(1 << 20)
    before = mapped_mb()
    copies = [to_mmap(source) for _ in range(20)]
    assert mapped_mb() - before > 75 and all(bool((copy == 1).all()) for copy in copies)
    view = copies[3][5:9]
    del copies
    gc.collect()
    assert mapped_mb() - before < 20
    assert view.tolist() == [1.0] * 4, "a view keeps its pages"


def test_extremes_of_images_of_any_shape_and_precision():
    part = torch.tensor(
        [[0.5, -2.0]], requires_grad=True
    )  # its numbers must not be read one by one, with a warning
    images = [part, torch.ones(3, 2, dtype=torch.float64), torch.tensor([3.0, torch.nan]).half()]
    found = extremes(images)
    assert found[:2] == [(-2.0, 0.5), (1.0, 1.0)] and torch.tensor(found[2]).isnan().all()
