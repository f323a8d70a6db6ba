"""Encode the context of windows, once for many runs: python benchmarks/encode_windows.py SHARDS MODEL OUT.

SHARDS is a folder that `viewmend samples windows` made, OUT gets as many shards, of the same windows with tokens
instead of camera images, for `viewmend train tokens --shards OUT --from MODEL`. What is there already stays: the same
command goes on with what was stopped. Some 2.5 windows a second and core, 0.6 MB each.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.network import set_compute_dtype
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.training.encoded import encode
from viewmend.training.sample_files import read_shard, shards_of, write_shards
from viewmend.training.samples import Sample


def windows(path: Path, net: PatchTransformer) -> Iterator[Sample]:
    """The windows of a shard, their context encoded."""
    for sample in read_shard(path):
        assert isinstance(sample, Sample) and sample.view.part is not None, "samples are windows"
        yield replace(sample, context=(), encoded=encode(net, sample.view, sample.context))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shards", type=Path)
    parser.add_argument("model")
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    net = load_network(options.model)
    assert isinstance(net, PatchTransformer), "no rays before its patches"
    set_compute_dtype(net.eval(), torch.bfloat16)
    paths = shards_of(options.shards)
    there = len(shards_of(options.out))
    for number, path in list(enumerate(paths))[there:]:
        made = list(windows(path, net))
        written = next(write_shards(made, options.out, len(made), number))
        print(f"{written}: {len(made)} windows, {number + 1} of {len(paths)} shards", flush=True)


if __name__ == "__main__":
    main()
