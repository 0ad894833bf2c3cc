"""Plain words and rounded numbers for what a diagnosis says; the report and the terminal share them.

Pages know the package as ``words``: what stands here is what they may use.
"""

from station.view.wording.commands import next_test, no_test, run_command, test_words
from station.view.wording.gain import ahead_times, any_step, beyond, far_off, gain_rows, gone, step_words, strained
from station.view.wording.latency import as_told
from station.view.wording.names import (
    CHANNELS,
    STATES,
    VERDICTS,
    cause_title,
    constant_title,
    plain,
    sentence,
)
from station.view.wording.numbers import decimal, digits_of, interval, number, percent, probability, resamples, unit_of
from station.view.wording.odds import outside_sentence, rest_sentence
from station.view.wording.ranking import ranked, why
from station.view.wording.remains import disturbance, remains_sentence, residual_words
from station.view.wording.runs import between_runs, predicted_ahead
from station.view.wording.verdict import verdict_sentence
from station.view.wording.wrong import fact, measure

__all__ = ["CHANNELS", "STATES", "VERDICTS", "ahead_times", "any_step", "as_told", "between_runs", "beyond",
           "cause_title", "constant_title", "decimal", "digits_of", "disturbance", "fact", "far_off", "gain_rows",
           "gone", "interval", "measure", "next_test", "no_test", "number", "outside_sentence", "percent", "plain",
           "predicted_ahead", "probability", "ranked", "remains_sentence", "resamples", "residual_words",
           "rest_sentence", "run_command", "sentence", "step_words", "strained", "test_words", "unit_of",
           "verdict_sentence", "why"]
