"""Masks by an ONNX network: tiny graphs with the interfaces of MODNet and BackgroundMattingV2."""

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="onnx writes the networks of this test")

from onnx import TensorProto, helper  # noqa: E402

from viewmend.preprocess.masks.maker import MaskMaker  # noqa: E402
from viewmend.preprocess.masks.network import NetworkMasks  # noqa: E402


def network(path, nodes, inputs, output):
    """Write a graph whose tensors are float32; `inputs` and `output` are names with shapes."""
    tensors = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in inputs.items()
    ]
    (name, shape), constants = output, [helper.make_tensor("half", TensorProto.FLOAT, [1], [0.5])]
    constants.append(helper.make_tensor("four", TensorProto.FLOAT, [1], [4.0]))
    told = helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
    graph = helper.make_graph(nodes, "matting", tensors, [told], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, path)
    return path


def modnet(path, shape=(1, 3, "height", "width")):
    """The mean of the channels, from [-1, 1] to [0, 1]."""
    nodes = [
        helper.make_node("ReduceMean", ["input"], ["mean"], axes=[1], keepdims=1),
        helper.make_node("Mul", ["mean", "half"], ["scaled"]),
        helper.make_node("Add", ["scaled", "half"], ["output"]),
    ]
    return network(path, nodes, {"input": list(shape)}, ("output", [1, 1, *shape[2:]]))


def background_matting(path):
    """Four times the largest difference of image and plate."""
    nodes = [
        helper.make_node("Sub", ["src", "bgr"], ["difference"]),
        helper.make_node("Abs", ["difference"], ["distance"]),
        helper.make_node("ReduceMax", ["distance"], ["largest"], axes=[1], keepdims=1),
        helper.make_node("Mul", ["largest", "four"], ["pha"]),
    ]
    shape = [1, 3, "height", "width"]
    return network(path, nodes, {"src": shape, "bgr": shape}, ("pha", [1, 1, "height", "width"]))


def image() -> np.ndarray:
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[16:32, 24:40] = 255
    return rgb


@pytest.mark.parametrize("shape", [(1, 3, "height", "width"), (1, 3, 96, 96)])
def test_a_network_of_one_image_gets_it_in_minus_1_to_1(tmp_path, shape):
    maker = NetworkMasks(modnet(tmp_path / "modnet.onnx", shape))
    assert isinstance(maker, MaskMaker)
    mask = maker.mask(image())
    assert mask.shape == (48, 64) and mask.dtype == np.uint8
    assert mask[20:28, 28:36].min() == 255 and mask[:10].max() == 0  # -1 became 0, and 1 became 255


def test_a_network_of_image_and_plate_sees_both_in_0_to_1(tmp_path):
    file = background_matting(tmp_path / "background_matting.onnx")
    plate = np.full((48, 64, 3), 64, np.uint8)
    rgb = plate.copy()
    rgb[16:32, 24:40] = 96
    mask = NetworkMasks(file, plate).mask(rgb)
    assert mask[24, 32] == 4 * (96 - 64) and mask[0, 0] == 0
    with pytest.raises(ValueError, match="64 x 48 pixels as the plate has"):
        NetworkMasks(file, plate).mask(rgb[:20])
    with pytest.raises(ValueError, match="expected clean plates for this network"):
        NetworkMasks(file)


def test_what_is_no_such_network_is_refused(tmp_path):
    with pytest.raises(ValueError, match="got no file; check --network"):
        NetworkMasks(tmp_path / "absent.onnx")
    (tmp_path / "words.onnx").write_text("no network")
    with pytest.raises(ValueError, match="expected a network as an ONNX file, got"):
        NetworkMasks(tmp_path / "words.onnx")
    with pytest.raises(ValueError, match="expected a network of an image"):
        NetworkMasks(modnet(tmp_path / "grey.onnx", (1, 1, 48, 64)))
    nodes = [helper.make_node("Identity", ["input"], ["output"])]
    shape = [1, 3, "height", "width"]
    colours = network(tmp_path / "colours.onnx", nodes, {"input": shape}, ("output", shape))
    with pytest.raises(ValueError, match="the matte, got none"):
        NetworkMasks(colours).mask(image())
