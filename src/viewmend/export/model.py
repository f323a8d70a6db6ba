"""Writes the default model as a file for other runtimes: an AOTInductor package (libtorch), or ONNX."""

import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor
from torch.export import Dim, ExportedProgram

from viewmend import __version__
from viewmend.export.traceable import LARGEST_PX, ExportedModel, ViewInputs, ViewOutputs
from viewmend.models.checkpoint import load_network, shipped_models
from viewmend.models.views.model import ViewSynthNet
from viewmend.utils.atomic_writes import write_atomically

Format = Literal["pt2", "onnx"]
"""An AOTInductor package, or ONNX."""
SMALLEST_PX = 64
"""Views and images have at least this many pixels along a side."""
MAX_CAMERAS = 64
"""A rig has at most this many cameras."""
EXAMPLE = {"height": 70, "width": 66, "rows": 67, "columns": 73, "chosen": 3, "camera": 5}
"""Sizes of the tensors that the model is traced with: all different, so that none is traced as
equal to another."""
OPSET = 18
"""The version of ONNX's operators."""
DTYPES = {"Float": torch.float32, "Int": torch.int64, "UInt8": torch.uint8, "Bool": torch.bool}
"""The types of the inputs, by their annotations."""
INDUCTOR_OPTIONS = {
    "joint_graph_constant_folding": False,
    "layout_optimization": False,
    "cpp.dynamic_threads": True,
    "cpp.simdlen": 1,
}
"""AOTInductor's options. Constant folding needs known sizes. With layout optimisation, convolutions
of a batch of unknown size give wrong results (torch 2.13). The caller sets the number of threads.
Vectorised kernels compile for minutes and gain little."""


def sizes(net: ViewSynthNet) -> dict[str, tuple[int, int]]:
    """Smallest and largest value of each size that the inputs' annotations name."""
    pixels = dict.fromkeys(("height", "width", "rows", "columns"), (SMALLEST_PX, LARGEST_PX))
    return pixels | {"chosen": (2, max(3, net.config.num_views)), "camera": (2, MAX_CAMERAS)}


def load_exportable(name: str) -> ViewSynthNet:
    """Load a model that can be exported.

    Raises:
        ValueError: it is no `ViewSynthNet`, or cannot be loaded (`WeightsError`).
    """
    known = name in shipped_models() or Path(name).is_dir()
    model = load_network(name) if known else None
    if not isinstance(model, ViewSynthNet):
        got = f"a {type(model).__name__}" if known else "which is neither a shipped model nor a folder"
        raise ValueError(
            f"expected 'views', or the folder of a model trained by viewmend train views, got '{name}', {got}; other "
            "models and methods cannot be exported"
        )
    return model


def trace(net: ViewSynthNet) -> ExportedProgram:
    """Trace the model for all sizes, in float32 on the CPU."""
    ranges = {size: Dim(size, min=low, max=high) for size, (low, high) in sizes(net).items()}
    dynamic = [{axis: ranges[size] for axis, size in axes.items()} for axes in _named_axes()]
    example: list[Tensor] = []
    for kind in ViewInputs.__annotations__.values():
        dtype = DTYPES[kind.__name__.split("[")[0]]
        shape = [EXAMPLE.get(size) or int(size) for size in kind.dim_str.split()]
        example.append(torch.ones(shape, dtype=dtype))
    # With symbolic sizes, the cache of traced operations takes longer than what it saves
    no_cache = torch._dynamo.config.patch(fake_tensor_cache_enabled=False)
    with torch.enable_grad(), no_cache, _quiet():  # with gradients, layers do not use compiled loops
        return torch.export.export(
            ExportedModel(net).eval().requires_grad_(False),
            tuple(example),
            dynamic_shapes=(tuple(dynamic),),
            prefer_deferred_runtime_asserts_over_guards=True,
        )


def _named_axes() -> tuple[dict[int, str], ...]:
    """The named axes of each input, by their number."""
    shapes = [kind.dim_str.split() for kind in ViewInputs.__annotations__.values()]
    return tuple({axis: size for axis, size in enumerate(shape) if size in EXAMPLE} for shape in shapes)


def metadata(net: ViewSynthNet, name: str) -> dict[str, str]:
    """Metadata of a file: model, names of inputs and outputs in order, and ranges of sizes."""
    ranges = ",".join(f"{size}={low}:{high}" for size, (low, high) in sizes(net).items())
    return {
        "viewmend_version": __version__,
        "viewmend_model": name,
        "viewmend_config": json.dumps(net.config.to_dict()),
        "inputs": ",".join(ViewInputs._fields),
        "outputs": ",".join(ViewOutputs._fields),
        "sizes": ranges,
    }


def check_compiler() -> None:
    """ValueError without the C++ compiler that AOTInductor needs."""
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler:
        raise ValueError(
            "expected a C++ compiler for --format pt2, found none; install one (Debian: apt-get install g++), set CXX "
            "to one, or use --format onnx"
        ) from None


def check_onnx() -> None:
    """ValueError without the packages that write ONNX."""
    absent = [name for name in ("onnx", "onnxscript") if find_spec(name) is None]
    if absent:
        raise ValueError(
            f"expected {' and '.join(absent)} for --format onnx, got none; pip install 'viewmend[all]'"
        )


def write_pt2(program: ExportedProgram, path: Path, notes: Mapping[str, str]) -> None:
    """Compile a program for this machine's processor, and write it as an AOTInductor package with its metadata.

    Raises:
        OSError: it cannot be written; then there is no file.
    """
    from torch._inductor import aoti_compile_and_package
    from torch._inductor.utils import fresh_cache

    configs = INDUCTOR_OPTIONS | {"aot_inductor.metadata": dict(notes)}

    def write(draft: Path) -> None:
        aoti_compile_and_package(program, package_path=str(draft), inductor_configs=configs)

    with _quiet(), fresh_cache():
        write_atomically(path, write, durable=True)


def write_onnx(program: ExportedProgram, path: Path, notes: Mapping[str, str]) -> None:
    """Write a program as one ONNX file with its metadata.

    Raises:
        OSError: it cannot be written; then there is no file.
    """
    with _quiet():
        made = torch.onnx.export(
            program,
            input_names=ViewInputs._fields,
            output_names=ViewOutputs._fields,
            dynamic_shapes=(_named_axes(),),  # the program is traced already: these are names only
            opset_version=OPSET,
            external_data=False,
            verbose=False,
            optimize=False,  # its rewriter compares every node with all others, for minutes
        )
        assert made is not None
        _simplify(made)
    made.model.metadata_props.update(notes)
    write_atomically(path, lambda draft: made.save(draft, external_data=False), durable=True)


def _simplify(made: "torch.onnx.ONNXProgram") -> None:
    """Fold constants and merge equal nodes: what pays of the exporter's optimisations, in a second or two."""
    from onnx_ir.passes import common
    from onnxscript import optimizer

    optimizer.fold_constants(made.model, onnx_shape_inference=False)
    passes = (
        common.RemoveUnusedNodesPass(),
        common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        common.DeduplicateInitializersPass(),
        common.CommonSubexpressionEliminationPass(),
    )
    for simplify in passes:
        simplify(made.model)


def check_format(format: Format) -> None:
    """ValueError if this machine lacks what is needed to write the format."""
    if format == "pt2":
        check_compiler()
    else:
        check_onnx()


def write_program(program: ExportedProgram, path: Path, format: Format, notes: Mapping[str, str]) -> None:
    """Write a program in this format with its metadata.

    Raises:
        OSError: it cannot be written; then there is no file.
    """
    if format == "pt2":
        write_pt2(program, path, notes)
    else:
        write_onnx(program, path, notes)


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide torch's warnings about deprecations and optional packages."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)
