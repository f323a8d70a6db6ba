"""A reader of whole views as a file: an AOTInductor package, or ONNX."""

import json
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import nn
from torch.export import Dim, ExportedProgram

from viewmend import __version__
from viewmend.atomic_writes import write_atomically
from viewmend.deployment.halvings import LARGEST_PX
from viewmend.deployment.view_inputs import ViewInputs, ViewOutputs
from viewmend.deployment.view_mender import ViewMender
from viewmend.inpainting.sweep.sweep_net import SweepNet

SMALLEST_PX = 64
"""Sides of views and images are no shorter."""
MOST_CAMERAS = 64
EXAMPLE = {"height": 70, "width": 66, "rows": 67, "columns": 73, "chosen": 3, "camera": 5}
"""Sizes at which a model is traced: each its own, so that none is taken for another."""
OPSET = 18
"""Version of ONNX's operators."""
DTYPES = {"Float": torch.float32, "Int": torch.int64, "UInt8": torch.uint8, "Bool": torch.bool}
"""What the inputs' annotations stand for."""
INDUCTOR = {
    "joint_graph_constant_folding": False,
    "layout_optimization": False,
    "cpp.dynamic_threads": True,
    "cpp.simdlen": 1,
}
"""Folding wants sizes that are known. Convolutions of a batch that is known only when it runs come out wrong where
layouts are optimised (torch 2.13). Threads are the caller's. Kernels that are not made for vectors by hand take a
compiler minutes less, and lookups gain little by them."""


def sizes(net: SweepNet) -> dict[str, tuple[int, int]]:
    """From where to where each size may be that the inputs' annotations name."""
    pixels = dict.fromkeys(("height", "width", "rows", "columns"), (SMALLEST_PX, LARGEST_PX))
    return pixels | {"chosen": (2, max(3, net.config.num_views)), "camera": (2, MOST_CAMERAS)}


def exportable(model: nn.Module | object, name: str) -> SweepNet:
    """The model, if it mends a view by what the cameras see at its own time.

    Raises:
        ValueError: it is no `SweepNet`: it looks at earlier times, or is no network at all.
    """
    if not isinstance(model, SweepNet):
        raise ValueError(
            f"expected a reader of whole views (viewmend_format 2, network sweep), got '{name}', a "
            f"{type(model).__name__}, which looks at a window of times or is no network; export 'views', or a model "
            "that viewmend train views made"
        )
    return model


def traced(net: SweepNet) -> ExportedProgram:
    """What `ViewMender` computes, for all sizes; it is traced in float32 on the CPU."""
    ranges = {size: Dim(size, min=low, max=high) for size, (low, high) in sizes(net).items()}
    example, dynamic = [], [{axis: ranges[size] for axis, size in own.items()} for own in _named_axes()]
    for kind in ViewInputs.__annotations__.values():
        dtype, shape = DTYPES[kind.__name__.split("[")[0]], kind.dim_str.split()
        example.append(torch.ones([EXAMPLE.get(size) or int(size) for size in shape], dtype=dtype))
    with torch.enable_grad(), _quiet():  # so that layers take the way of training, which is no compiled loop
        return torch.export.export(
            ViewMender(net).eval().requires_grad_(False),
            tuple(example),
            dynamic_shapes=(tuple(dynamic),),
            prefer_deferred_runtime_asserts_over_guards=True,
        )


def _named_axes() -> tuple[dict[int, str], ...]:
    """The axes of each input that have a name, with it."""
    shapes = [kind.dim_str.split() for kind in ViewInputs.__annotations__.values()]
    return tuple({axis: size for axis, size in enumerate(shape) if size in EXAMPLE} for shape in shapes)


def metadata(net: SweepNet, name: str) -> dict[str, str]:
    """What a file says of itself: the model, names in their order, and ranges of sizes."""
    ranges = ",".join(f"{size}={low}:{high}" for size, (low, high) in sizes(net).items())
    return {
        "viewmend_version": __version__,
        "viewmend_model": name,
        "viewmend_config": json.dumps(net.config.to_dict()),
        "inputs": ",".join(ViewInputs._fields),
        "outputs": ",".join(ViewOutputs._fields),
        "sizes": ranges,
    }


def demand_compiler() -> None:
    """ValueError where there is no C++ compiler, which AOTInductor needs."""
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler:
        raise ValueError(
            "expected a C++ compiler for --format pt2, found none; install one (Debian: apt-get install g++) or name "
            "it in CXX, or take --format onnx"
        ) from None


def demand_onnx() -> None:
    """ValueError where there is nothing to write ONNX with."""
    absent = [name for name in ("onnx", "onnxscript") if find_spec(name) is None]
    if absent:
        raise ValueError(f"expected {' and '.join(absent)} for --format onnx, got none; pip install 'viewmend[export]'")


def write_pt2(program: ExportedProgram, path: Path, told: Mapping[str, str]) -> None:
    """Compile a program for this machine's processor, as an AOTInductor package that is whole or not there.

    Raises:
        OSError: it cannot be written.
    """
    from torch._inductor import aoti_compile_and_package
    from torch._inductor.utils import fresh_cache

    configs = INDUCTOR | {"aot_inductor.metadata": dict(told)}

    def write(beside: Path) -> None:
        aoti_compile_and_package(program, package_path=str(beside), inductor_configs=configs)

    with _quiet(), fresh_cache():
        write_atomically(path, write, durable=True)


def write_onnx(program: ExportedProgram, path: Path, told: Mapping[str, str]) -> None:
    """Write a program as ONNX, one file that is whole or not there.

    Raises:
        OSError: it cannot be written.
    """
    with _quiet():
        made = torch.onnx.export(
            program,
            input_names=ViewInputs._fields,
            output_names=ViewOutputs._fields,
            dynamic_shapes=(_named_axes(),),  # of a program that is traced already: names alone
            opset_version=OPSET,
            external_data=False,
            verbose=False,
        )
    assert made is not None
    made.model.metadata_props.update(told)
    write_atomically(path, lambda beside: made.save(beside, external_data=False), durable=True)


FORMATS: dict[str, tuple[Callable[[], None], Callable[[ExportedProgram, Path, Mapping[str, str]], None]]] = {
    "pt2": (demand_compiler, write_pt2),
    "onnx": (demand_onnx, write_onnx),
}
"""What each format needs, and how it is written."""


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep torch's own remarks on deprecations, and on packages that are not needed, from the user."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)
