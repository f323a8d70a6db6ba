"""A tiny model in both formats, and the C++ example upon it: what they give is what the model gives."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from reference.random_views import holed, images, mended, random_view
from safetensors.torch import load_file

from viewmend.export.traceable import ViewInputs, ViewOutputs
from viewmend.models.checkpoint import load_inpainter, save_inpainter
from viewmend.models.views.config import ViewsConfig
from viewmend.models.views.model import ViewSynthNet
from viewmend.utils.weight_files import write_tensors

ROOT = Path(__file__).resolve().parents[3]
CONFIG = ViewsConfig(num_views=4, width=8, sample_channels=4, features=8, fine_features=8, coarse_fill="rays")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("model") / "tiny"
    save_inpainter(ViewSynthNet(CONFIG), folder, "# card")
    return folder


@pytest.fixture(scope="module")
def net(model):
    return load_inpainter(model, precision="float32").requires_grad_(False)


def exported(model, out):
    """What the command writes, run as users run it: the type checks of tests are not to be traced."""
    command = [
        sys.executable,
        "-m",
        "viewmend",
        "export",
        str(model),
        "--format",
        out.suffix[1:],
        "--out",
        str(out),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    return out


@pytest.fixture(scope="module")
def package(model, tmp_path_factory):
    return exported(model, tmp_path_factory.mktemp("pt2") / "tiny.pt2")


@pytest.fixture(scope="module")
def network(model, tmp_path_factory):
    return exported(model, tmp_path_factory.mktemp("onnx") / "tiny.onnx")


def views(net):
    """Random views, some with large holes, and one without a subject."""
    for seed in range(6):
        view, context = random_view(seed, net, longest=150)
        yield (holed(view) if seed % 2 else view), context


def nothing(given):
    """The same rig before an empty view."""
    zeros = {
        name: torch.zeros_like(getattr(given, name)) for name in ("rgb", "mask", "error", "depth", "weights")
    }
    return given._replace(**zeros)


def demand_equal(net, run):
    sizes = set()
    for view, context in views(net):
        given = ViewInputs.of(view, context, net.config.num_views)
        sizes |= {given.mask.shape, given.masks.shape}
        wanted = images(mended(net, view, context))
        for name, own in zip(ViewOutputs._fields, run(given), strict=True):
            torch.testing.assert_close(own, wanted[name], atol=1e-3, rtol=0, msg=name)
    assert len(sizes) > 8
    assert all(float(image.abs().max()) == 0 for image in run(nothing(given)))


def test_a_package_mends_as_the_model(net, package):
    run = torch._inductor.aoti_load_package(str(package))
    demand_equal(net, lambda given: run(*given))
    told = run.get_metadata()
    assert told["inputs"].split(",") == list(ViewInputs._fields)
    assert told["viewmend_model"].endswith("tiny") and "height=64:4096" in told["sizes"]


def test_onnx_mends_as_the_model(net, network):
    session = onnxruntime.InferenceSession(network)

    def run(given):
        arrays = {name: tensor.numpy() for name, tensor in given._asdict().items()}
        return [torch.from_numpy(np.asarray(image)) for image in session.run(None, arrays)]

    demand_equal(net, run)
    read = onnx.load(network)
    assert {entry.key: entry.value for entry in read.metadata_props}["outputs"] == ",".join(
        ViewOutputs._fields
    )
    shapes = {
        own.name: [axis.dim_param for axis in own.type.tensor_type.shape.dim] for own in read.graph.input
    }
    assert shapes["rgb"][1:] == ["height", "width"] and shapes["masks"] == ["camera", "rows", "columns"]


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The example, built as the guide says."""
    build = tmp_path_factory.mktemp("cpp")
    source = ["-S", str(ROOT / "examples/cpp"), "-B", str(build), "-DCMAKE_BUILD_TYPE=Release"]
    subprocess.run(["cmake", *source, f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"], check=True)
    subprocess.run(["cmake", "--build", str(build)], check=True)
    return build / "mend_view"


def test_riftcasts_call_mends_holes_alone_bottom_up(net, package, program, tmp_path):
    view, context = random_view(1, net, longest=120)
    view = holed(view)
    view = replace(view, error=view.holes.float())
    given = ViewInputs.of(view, context, net.config.num_views)
    image = torch.where(
        view.mask > 0, view.rgb, 1.0
    )  # on white and with four channels, as it is rendered there
    shown = (torch.cat([image, torch.ones_like(image[:1])]) * 255).round().byte()
    more = {
        "image": shown.movedim(0, 2).flip(0).contiguous(),
        "missing": view.error[..., None].flip(0).contiguous(),
    }
    del (tensors := given._asdict())["rgb"], tensors["error"]
    write_tensors(tmp_path / "view.safetensors", tensors | more, {})
    done = ran(
        program.with_name("inpaint"), package, tmp_path / "view.safetensors", tmp_path / "out.safetensors"
    )
    assert done.returncode == 0, done.stderr
    got = load_file(tmp_path / "out.safetensors")["inpainted"].flip(0).movedim(2, 0)
    right = view.error == 0
    assert torch.equal(got[:, right], shown[:3, right].float()) and int((~right).sum()) > 100
    wanted = mended(net, replace(view, rgb=(view.rgb * 255).round() / 255), context).rgb
    assert float((got / 255 - wanted)[:, ~right].abs().max()) < 0.5 / 255 + 2e-3


def ran(program, *paths):
    return subprocess.run(
        [str(program), *map(str, paths)], capture_output=True, text=True, check=False, env=os.environ
    )


def test_the_example_in_cpp_mends_as_the_model(net, package, program, tmp_path):
    view, context = random_view(3, net, longest=150)
    given = ViewInputs.of(view, context, net.config.num_views)
    write_tensors(tmp_path / "view.safetensors", given._asdict(), {"note": "a head may say more"})
    paths = [tmp_path / name for name in ("view.safetensors", "out.ppm", "out.safetensors")]
    done = ran(program, package, *paths)
    assert done.returncode == 0, done.stderr
    got, wanted = load_file(paths[2]), images(mended(net, view, context))
    for name in ViewOutputs._fields:
        torch.testing.assert_close(got[name], wanted[name], atol=1e-3, rtol=0)
    head, size, most, pixels = paths[1].read_bytes().split(b"\n", 3)
    height, width = view.mask.shape
    assert (head, size, most) == (b"P6", f"{width} {height}".encode(), b"255")
    picture = torch.frombuffer(bytearray(pixels), dtype=torch.uint8).view(height, width, 3)
    assert float((picture.movedim(-1, 0) / 255 - wanted["completed_rgb"]).abs().max()) < 0.5 / 255 + 1e-3


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda head: b"", "a whole head"),
        (lambda head: (1 << 40).to_bytes(8, "little") + head[8:], "a whole head"),
        (lambda head: head.replace(b'"F32"', b'"F64"', 1), "F32, I64, U8 or BOOL"),
        (lambda head: head.replace(b'"shape":[', b'"shape":[9000000000000000000,', 1), "a shape that fits"),
        (lambda head: head.replace(b'"data_offsets":[0', b'"data_offsets":[8', 1), "the numbers of"),
        (lambda head: head.replace(b'"error"', b'"wrong"', 1), "expected the tensor error, got none"),
        (lambda head: head.replace(b'"shape":[', b'"shape":[x', 1), "whole numbers"),
    ],
)
def test_the_example_refuses_spoilt_views_in_one_line(net, package, program, tmp_path, spoil, said):
    view, context = random_view(0, net, longest=100)
    path = tmp_path / "view.safetensors"
    write_tensors(path, ViewInputs.of(view, context, 4)._asdict(), {})
    path.write_bytes(spoil(path.read_bytes()))
    done = ran(program, package, path, tmp_path / "out.ppm")
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert str(path) in done.stderr and said in done.stderr
    assert not (tmp_path / "out.ppm").exists()
