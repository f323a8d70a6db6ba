"""Slow, obvious twin of viewmend.training.adversarial: the formulas as they are written, one logit at a time."""

from math import exp, log


def sigmoid(x):
    return 1 / (1 + exp(-x))


def discriminator_twin(real, fake, objective):
    if objective == "hinge":
        return average([max(0, 1 - x) for x in real]) + average([max(0, 1 + x) for x in fake])
    return -average([log(sigmoid(x)) for x in real]) - average([log(1 - sigmoid(x)) for x in fake])


def generator_twin(fake, objective):
    return average(
        {
            "gan": [log(1 - sigmoid(x)) for x in fake],
            "nonsaturating": [-log(sigmoid(x)) for x in fake],
            "hinge": [-x for x in fake],
        }[objective]
    )


def average(values):
    return sum(values) / len(values)
