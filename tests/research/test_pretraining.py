"""The patch autoencoder from which `paper-small` starts."""

from dataclasses import replace

import pretrain_paper
import torch
from training.conftest import MODEL, RUN, SAMPLING, SCENES, studio_samples

from viewmend.models.checkpoint import load_network
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.paper.tokenizer import build_context_input
from viewmend.training.config import TrainConfig
from viewmend.training.loop import train
from viewmend.training.shards import write_shards

SCENES_128 = replace(SCENES, sizes_px=(128,))
OPTIONS = pretrain_paper.AutoencoderConfig(model=MODEL, sampling=SAMPLING)


def test_crops_give_the_patches_and_tokens_of_whole_images():
    """Only patches in the middle of a crop: at its edges the encoder sees other pixels."""
    torch.manual_seed(0)
    sample, model = studio_samples("crops", SCENES_128).scene(0)[0], PatchTransformer(MODEL).eval()
    image = build_context_input(sample.context[0], MODEL)
    side, own = pretrain_paper.CROP_PX, image.places
    with torch.no_grad():
        decoded, patches = pretrain_paper.reproduce(model, image.channels[..., :side, :side])
        tokens = model.tokeniser([image])
    middle = ((own[:, 1:] >= 2) & (own[:, 1:] <= 4)).all(1)
    places = own[(own[:, 1:] <= pretrain_paper.STEPS_A_SIDE).all(1)]
    assert len(places) == len(patches) and bool(middle.any())
    for number, (view, row, col) in enumerate(places.tolist()):
        expected = image.channels[view, :3, 16 * row : 16 * row + 28, 16 * col : 16 * col + 28]
        assert torch.equal(patches[number], expected)
    inner = ((places[:, 1:] >= 2) & (places[:, 1:] <= 4)).all(1)
    assert torch.allclose(decoded[inner], model.decoder(tokens[middle]).float(), atol=1e-4)


def test_it_trains_encoder_and_decoder_alone(tmp_path):
    samples = studio_samples("crops", SCENES_128).scene(0)
    list(write_shards(samples, tmp_path / "shards"))
    config = TrainConfig(
        name="autoencoder", objective=OPTIONS, scenes=SCENES_128, shards=tmp_path / "shards", **RUN
    )
    train(config, tmp_path / "run")
    torch.manual_seed(config.seed)
    start, trained = (
        OPTIONS.make_objective(config, OPTIONS, None).model.state_dict(),
        load_network(tmp_path / "run"),
    )
    changed = {
        name.split(".")[0]
        for name, weight in trained.state_dict().items()
        if not torch.equal(weight, start[name])
    }
    assert changed == {"tokeniser", "decoder"}
