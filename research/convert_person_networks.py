"""Convert MediaPipe's pose networks to the ONNX files in src/viewmend/weights/person.

Needs tensorflow, tf2onnx and onnx in an environment of their own, and the wheel of mediapipe 0.10.21:

    pip download --no-deps mediapipe==0.10.21
    python research/convert_person_networks.py mediapipe-0.10.21-*.whl OUT
"""

import argparse
import tempfile
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

MODELS = {
    "detector": "mediapipe/modules/pose_detection/pose_detection.tflite",
    "segmenter": "mediapipe/modules/pose_landmark/pose_landmark_full.tflite",
}


def dense_weights(model: Path) -> dict[str, np.ndarray]:
    """The outputs of all DENSIFY operations by the name of their sparse input; tf2onnx does not know these."""
    import tensorflow as tf

    resolver = tf.lite.experimental.OpResolverType.BUILTIN_WITHOUT_DEFAULT_DELEGATES
    run = tf.lite.Interpreter(
        str(model), experimental_preserve_all_tensors=True, experimental_op_resolver_type=resolver
    )
    run.allocate_tensors()
    details = run.get_input_details()[0]
    run.set_tensor(details["index"], np.zeros(details["shape"], np.float32))
    run.invoke()
    names = {tensor["index"]: tensor["name"] for tensor in run.get_tensor_details()}
    dense = [op for op in run._get_ops_details() if op["op_name"] == "DENSIFY"]
    return {names[op["inputs"][0]]: run.get_tensor(op["outputs"][0]) for op in dense}


def with_dense_constants(parse, dense: dict[str, np.ndarray]):
    """`tflite_utils.parse_tflite_graph` with the sparse constants replaced by dense ones."""
    from tensorflow.python.framework import tensor_util
    from tf2onnx import tflite_utils

    def decode(proto):
        try:
            return tensor_util.MakeNdarray(proto)
        except ValueError:  # a sparse constant, replaced below
            return np.zeros(1, np.float32)

    def wrapped(*args, **kwargs):
        tflite_utils.tensor_util = SimpleNamespace(MakeNdarray=decode)
        nodes, *rest = parse(*args, **kwargs)
        constants = [
            helper.make_node("Const", [], [name], name, value=numpy_helper.from_array(value, name))
            for name, value in dense.items()
        ]
        return ([*constants, *(node for node in nodes if node.output[0] not in dense)], *rest)

    return wrapped


def in_half_precision(model: onnx.ModelProto) -> onnx.ModelProto:
    """Store weights that float16 holds exactly as float16, cast to float32 when the model is loaded."""
    graph, kept, casts = model.graph, [], []
    for weight in graph.initializer:
        value = numpy_helper.to_array(weight)
        half = value.astype(np.float16) if value.dtype == np.float32 and value.size > 64 else None
        if half is None or not np.array_equal(half.astype(np.float32), value):
            kept.append(weight)
            continue
        kept.append(numpy_helper.from_array(half, f"{weight.name}_f16"))
        casts.append(helper.make_node("Cast", [f"{weight.name}_f16"], [weight.name], to=TensorProto.FLOAT))
    nodes = list(graph.node)
    for node in nodes:
        if node.op_type == "TFL_DENSIFY":
            node.op_type, node.domain = "Identity", ""
    del graph.initializer[:], graph.node[:]
    graph.initializer.extend(kept)
    graph.node.extend([*casts, *nodes])
    onnx.checker.check_model(model)
    return model


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheel", type=Path, help="the wheel of mediapipe")
    parser.add_argument("out", type=Path, help="an existing folder")
    options = parser.parse_args()

    from tf2onnx import convert, tflite_utils
    from tf2onnx.handler import tfl_op

    tfl_op("TFL_DENSIFY", onnx_op="Identity")(type("Densify", (), {}))
    parse = tflite_utils.parse_tflite_graph
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(options.wheel) as package:
        for name, path in MODELS.items():
            model = Path(package.extract(path, folder))
            tflite_utils.parse_tflite_graph = with_dense_constants(parse, dense_weights(model))
            converted, _ = convert.from_tflite(str(model), opset=17)
            onnx.save(in_half_precision(converted), options.out / f"{name}.onnx")


if __name__ == "__main__":
    main()
