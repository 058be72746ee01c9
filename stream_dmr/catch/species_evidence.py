"""The species of a fish from what a classifier says of its frames."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from stream_dmr.catch.species_list import load_species
from stream_dmr.catch.species_settings import SpeciesSettings

UNSURE = "unsure"
_LEAST = 1e-3  # what one frame says against a species is never more: it may show a hand. Chosen.


class SpeciesFound(NamedTuple):
    """The likeliest species of a fish."""

    code: str  # FAO 3-alpha
    share: float  # its posterior probability


class SpeciesEvidence:
    """Takes the frames of one fish.

    Of n frames with probabilities p_t, the posterior of species s is

        p(s) = exp(m mean_t log p_t(s)) / sum,    m = n / (1 + (n - 1) r)

    where m is the number of independent frames that n frames are worth whose errors have the
    correlation r, as for the mean of equally correlated numbers (Kish, Survey Sampling, 1965, 5.4).
    All species are as likely beforehand.
    """

    def __init__(self, settings: SpeciesSettings) -> None:
        self._correlation = settings.frame_correlation
        self._sums: dict[str, float] = {}  # of log probabilities, by code
        self._num_frames = 0

    def add(self, probabilities: Mapping[str, float]) -> None:
        """Take one frame; nothing where no classifier looked at it."""
        if not probabilities:
            return
        self._num_frames += 1
        for code, probability in probabilities.items():
            self._sums[code] = self._sums.get(code, 0.0) + math.log(max(probability, _LEAST))

    def posterior(self) -> dict[str, float]:
        """The probability of each species; empty where no frame says anything."""
        if not self._num_frames:
            return {}
        worth = self._num_frames / (1 + (self._num_frames - 1) * self._correlation)
        logs = {code: worth * total / self._num_frames for code, total in self._sums.items()}
        largest = max(logs.values())
        weights = {code: math.exp(log - largest) for code, log in logs.items()}
        total = sum(weights.values())
        return {code: weight / total for code, weight in weights.items()}

    def best(self) -> SpeciesFound | None:
        """The likeliest species; None where no frame says anything."""
        posterior = self.posterior()
        if not posterior:
            return None
        code = max(posterior, key=lambda one: posterior[one])
        return SpeciesFound(code, posterior[code])


def forms_of_species(settings: SpeciesSettings) -> dict[str, str]:
    """The body form that each species is near to, by code. Raises ConfigError."""
    forms = {one.code: one.form for one in load_species(settings.own_list) if one.form}
    for pair in settings.forms:
        code, _, form = pair.partition("=")
        forms[code.strip()] = form.strip()
    return forms
