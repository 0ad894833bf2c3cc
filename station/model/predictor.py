"""One-step-ahead prediction of a run: the compiled stepper with an observer's gain (innovations form).

    e[i] = y[i] - yhat[i],   s+ = s + K e[i],   d = phi d+,   z[i+1] = simulated from z+ with the command and d

s = [z, d, v]: the modes z, a torque d at the motor (counts) and an error v of the accelerometer (counts), each of which
returns to its mean (Gauss-Markov).  With K = 0 it is the simulation driven by the logged command (output error).
Ljung, System Identification (2nd ed., 1999), sections 4.3 and 13.4 (direct method); Kristensen, Madsen and Jorgensen,
Automatica 40 (2004) 225.
"""

from __future__ import annotations

import numpy as np

from station.model.compiled import kernel
from station.model.stepper import _advance, begin, sense


@kernel()
def _predict(plan, state, gain, decay, tip, tip_feed, offset, command, measured, valid, predicted, disturbance, work):
    begin(plan, state)
    size = state.z.size
    d, f, v = 0.0, 0.0, 0.0
    for row in range(command.size):
        encoder, accel = sense(plan, state, offset, False)
        accel += v + tip_feed * f
        predicted[0, row], predicted[1, row] = encoder, accel
        if valid[row] > 0.0:
            one, two = measured[0, row] - encoder, measured[1, row] - accel
            for i in range(size):
                state.z[i] += gain[i, 0] * one + gain[i, 1] * two
            d += gain[size, 0] * one + gain[size, 1] * two
            f += gain[size + 1, 0] * one + gain[size + 1, 1] * two
            v += gain[size + 2, 0] * one + gain[size + 2, 1] * two
        d *= decay[0]
        f *= decay[1]
        v *= decay[2]
        disturbance[0, row] = d
        disturbance[1, row] = f
        _advance(plan, state, command[row], d, work)
        for i in range(size):
            state.z[i] += tip[i] * f


def predict_ticks(plan, state, gain, decay, tip, tip_feed, offset, command, measured):
    rows = command.size
    predicted, disturbance = np.zeros((2, rows)), np.zeros((2, rows))
    _predict(plan, state, gain, decay, tip, tip_feed, offset, command, measured, np.ones(rows), predicted, disturbance,
             np.zeros((4, max(plan.port_joint.size, 1))))
    return predicted, disturbance
