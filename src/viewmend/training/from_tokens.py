"""The transformer alone learns, from windows that the encoder it begins with has encoded. Ours."""

from collections.abc import Sequence
from dataclasses import replace

from viewmend.inpainting.chain import Chain
from viewmend.inpainting.context import ContextFrame
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.training.encoded import encode, fingerprint, with_keys
from viewmend.training.objective import Objective
from viewmend.training.plan import Recipe
from viewmend.training.samples import Sample


def encoded(net: PatchTransformer, sample: Sample) -> Sample:
    """The sample with its context as this net encodes it, instead of images."""
    return replace(sample, context=(), encoded=encode(net, sample.view, sample.context))


class TokensObjective(Objective):
    """L without L_adv, of samples whose context is encoded; of the view itself tokens are made anew, without gradients.

    The encoder is that of the model as the run begins: it does not learn, or the stored tokens would be another's.
    """

    def __init__(self, model: Chain | PatchTransformer, recipe: Recipe) -> None:
        super().__init__(model, recipe)
        self.encoder = fingerprint(self.patches)

    def contexts(self, samples: Sequence[Sample]) -> Sequence[Sequence[ContextFrame]]:
        """The frames of each sample, with the keys and values that are learned.

        Raises:
            ValueError: a sample's context is images, or tokens of another encoder.
        """
        known = [sample.encoded for sample in samples]
        got = {"none, but images" if encoded is None else encoded.encoder for encoded in known} - {self.encoder}
        if got:
            raise ValueError(
                f"expected samples that this model's encoder ({self.encoder}) encoded, got {', '.join(sorted(got))}; "
                "make them with the model that the run begins with: viewmend samples tokens --encoder MODEL"
            )
        pairs = zip(samples, known, strict=True)
        return [with_keys(self.patches, s.view, encoded) for s, encoded in pairs if encoded is not None]
