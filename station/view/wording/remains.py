"""What is left over: residuals, and the torque that is still missing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from station.view.wording.numbers import percent

if TYPE_CHECKING:
    from station.diagnose.result import Diagnosis


def leaves_noise(diagnosis: Diagnosis) -> bool:
    """Whether the verdict says that what is left, over whole runs, is noise and stated uncertainty."""
    return diagnosis.outside == 0.0


def residual_words(larger: bool, white: bool, followed: int) -> str:
    """What a residual one sample ahead looks like.

    ``larger``: than the noise; ``white``: whether its lags pass for white noise; ``followed``: the lags at which an
    earlier command shows.
    """
    if not larger:
        return "noise" if white and not followed else "no larger than the noise"
    return f"larger than the noise{', and it follows the command' if followed else ''}"


def remains_sentence(diagnosis: Diagnosis, larger: int, of: int) -> str:
    """What is left over whole runs, as the verdict has it, and one sample ahead: ``larger`` residuals of ``of``."""
    count = "the residual is" if of == 1 else f"{larger} of {of} residuals {'is' if larger == 1 else 'are'}"
    ahead = f"one sample ahead {count} larger than the sensors' noise"
    if leaves_noise(diagnosis):
        whole = ("Over whole runs, by which the verdict judges, what is left is noise"
                 f"{' and stated uncertainty' if diagnosis.verdict != 'not_enough_data' else ''}")
        none = "one sample ahead no residual is larger than the sensors' noise"
        return f"{whole}; {ahead if larger else none}."
    whole = "Over whole runs, by which the verdict judges, more than noise is left"
    return f"{whole}; {ahead}." if larger else f"{whole}; one sample ahead it does not show."


def disturbance(diagnosis: Diagnosis) -> str:
    """What torque is still missing at the motor, as a sentence; empty where it was not worked out."""
    found = diagnosis.disturbance
    if found is None:
        return ""
    words = (f"The torque that must be missing at the motor to meet the angle a few hundredths of a second ahead is "
             f"{percent(found.nominal)} of the command's rms torque with the rig file as it is, "
             f"{percent(found.refitted)} with its constants re-fitted")
    return f"{words}, {percent(found.extended)} with the causes." if diagnosis.causes else f"{words}."
