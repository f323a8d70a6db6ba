"""The model card that goes with weights: what trained them. What they score is for the evaluation to add."""

import torch

from viewmend.training.plan import Recipe
from viewmend.training.run_files import RunState


def model_card(recipe: Recipe, state: RunState) -> str:
    """Markdown for README.md beside the weights."""
    data = recipe.data
    if data.shards is not None:
        source = "shards made ahead"
    else:
        source = "studio scenes made on the fly"
        if data.performers is not None:
            source += f", {data.performers_fraction:.0%} of them with glTF performers"
        if data.captures:
            source += (
                f", and {data.captures_fraction:.0%} of all from {len(data.captures)} captures of the trainer's own"
            )
    terms = {name: getattr(recipe.loss, name) for name in ("log_error", "adversarial", "attention", "autoencoder")}
    extra = ", ".join(f"{weight:g} x {name.replace('_', ' ')}" for name, weight in terms.items() if weight)
    l1 = (
        "of patches of camera images" if recipe.part == "autoencoder" else "inside and outside of the holes (section 8)"
    )
    averaged = "; averaged weights" if recipe.ema else ""
    hardware = torch.cuda.get_device_name() if torch.cuda.is_available() else f"{torch.get_num_threads()} CPU threads"
    return f"""# {recipe.name}

Trained by `viewmend train {recipe.name}`: {state.step} steps of {recipe.batch} samples
x {len(state.positions)} streams in {state.elapsed_s / 60:.0f} minutes, seed {recipe.seed}, part `{recipe.part}`,
torch {torch.__version__}, {hardware}.
Loss: L1 {l1}{", " + extra if extra else ""}{averaged}.
Data: {source}; no test seeds, performers or motions.
"""
