"""The mean of the weights of several models of the same config, as a model.

    python research/average_weights.py MODEL... --out FOLDER

Its card contains the cards of these models.
"""

from pathlib import Path
from typing import Annotated

import tyro
from torch.optim.swa_utils import AveragedModel

from viewmend.models.checkpoint import CARD, Model, load_network, model_folder, save_inpainter


def average_weights(models: Annotated[tuple[str, ...], tyro.conf.Positional], out: Path) -> Model:
    """Write and return the mean.

    Args:
        models: names or folders of two models or more.
        out: folder of the mean.

    Raises:
        ValueError: fewer than two models, or models of different configs.
    """
    if len(models) < 2:
        raise ValueError(f"expected two models or more, got {len(models)}; name them one after another")
    networks = [load_network(model) for model in models]
    for name, network in zip(models, networks, strict=True):
        if network.config != networks[0].config:
            raise ValueError(
                f"expected models of the same config, got another for {name} than for {models[0]}"
            )
    mean = AveragedModel(networks[0])
    for network in networks:
        mean.update_parameters(network)
    cards = "\n".join(f"#{(model_folder(model) / CARD).read_text('utf-8')}" for model in models)
    save_inpainter(
        mean.module, out, f"# {out.name}\n\nThe mean of the weights of the following models.\n\n{cards}"
    )
    return mean.module


if __name__ == "__main__":
    tyro.cli(average_weights)
