"""The finite element model of Trutter's thesis as it was run, and what made it worse with every element.

    python scripts/thesis_model.py [--logs FOLDER] [--figure FILE.svg]

The thesis takes Meirovitch's coordinates h theta (h the element's length) for all rotations.  Base, springs
and tip inertia are then divided by h^2, but its program leaves the motor's inertia and damping as they are,
and its input is u h.  A torque tau does the work tau / h on a coordinate h theta, and an inertia J weighs J
/ h^2: so the program's motor is one whose gain, inertia and damping are all h^2 times those that were put
in.  With every element added the motor's share of the rig shrinks, and with it the damping.  Nothing is
wrong with large matrices.

Beside it, the thesis's state feedback ``A_bm - Kp*B_bm``: B is a column, which NumPy broadcasts over all
columns of A, so what is fed back is the sum of all states, angles, deflections and velocities alike.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.linalg

from station.model import linear
from station.rig import Rig, load_rig

SAMPLE_RATE = 500.0
LEAD = ((18.32547182, -17.20911971), 0.77672958)
"""The lead compensator's coefficients from the header of the laboratory's log."""


@dataclass(frozen=True)
class Model:
    """x' = a x + b u, encoder = c x; command u and encoder in counts."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray

    def sampled(self) -> tuple[np.ndarray, np.ndarray]:
        """Under a zero-order hold, exact."""
        n = len(self.b)
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n] = self.a, self.b
        step = scipy.linalg.expm(block / SAMPLE_RATE)
        return step[:n, :n], step[:n, n]

    def first_mode(self) -> float:
        """Size of the first oscillating pole over 2 pi, Hz."""
        poles = np.linalg.eigvals(self.a)
        return float(np.abs(poles[poles.imag > 1e-6]).min() / (2.0 * np.pi))


def thesis_model(elements: int) -> Model:
    """The thesis's program (sections 4.1 and 4.2), with the constants of ``sflr-unit``; no beam damping."""
    rig = load_rig("sflr-unit")
    h = rig.beam.length / elements
    mass_e = rig.beam.mass_per_length * h / 420.0 * np.array(
        [[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]])
    stiffness_e = rig.beam.flexural_rigidity / h**3 * np.array(
        [[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]])
    size = 2 * elements + 3
    mass, damping, stiffness = (np.zeros((size + 1, size + 1)) for _ in range(3))
    for i in range(elements):
        at = slice(2 * i + 2, 2 * i + 6)
        mass[at, at] += mass_e
        stiffness[at, at] += stiffness_e
    kept = np.r_[0, 1, 3:size + 1]     # the root does not move sideways
    mass, damping, stiffness = (m[np.ix_(kept, kept)] for m in (mass, damping, stiffness))
    mass[0, 0] += rig.motor.inertia                     # not divided by h^2
    damping[0, 0] += rig.motor.damping                  # not divided by h^2
    mass[1, 1] += rig.base.inertia / h**2
    mass[-2, -2] += rig.tip.mass
    mass[-1, -1] += rig.tip.inertia / h**2
    pair = np.array([[1.0, -1.0], [-1.0, 1.0]])
    for at, joint in ((slice(0, 2), rig.drive), (slice(1, 3), rig.clamp)):
        stiffness[at, at] += pair * joint.stiffness / h**2
        damping[at, at] += pair * joint.damping / h**2
    inverse = np.linalg.inv(mass)
    a = np.block([[np.zeros((size, size)), np.eye(size)], [-inverse @ stiffness, -inverse @ damping]])
    b = np.concatenate([np.zeros(size), inverse[:, 0] * h * rig.motor.gain])
    c = np.zeros(2 * size)
    c[1] = 1.0 / (h * rig.angle_per_count)
    return Model(a, b, c)


def same_in_radians(elements: int) -> Rig:
    """The rig that the thesis's program describes: the motor times h^2, no beam damping."""
    rig = load_rig("sflr-unit")
    factor = (rig.beam.length / elements) ** 2
    motor = {key: getattr(rig.motor, key) * factor for key in ("inertia", "damping", "gain")}
    beam = {"damping": 0.0, "elements": elements}
    return rig.model_copy(update={"motor": rig.motor.model_copy(update=motor),
                                  "beam": rig.beam.model_copy(update=beam)})


def unit_rig(elements: int) -> Rig:
    """``sflr-unit`` with another number of elements."""
    rig = load_rig("sflr-unit")
    return rig.model_copy(update={"beam": rig.beam.model_copy(update={"elements": elements})})


def model_of(rig: Rig) -> Model:
    """Station's model of a rig in this script's form."""
    system = linear.state_space(rig)
    return Model(system.A, system.B[:, 0], system.C[0])


def respond(model: Model, inputs: np.ndarray) -> np.ndarray:
    """Encoder (counts) for held inputs, from rest."""
    phi, gamma = model.sampled()
    x, out = np.zeros(len(gamma)), np.zeros(len(inputs))
    for i, u in enumerate(inputs):
        out[i] = model.c @ x
        x = phi @ x + gamma * u
    return out


def step_response(model: Model, controller: str, amplitude: float, samples: int = 1000) -> np.ndarray:
    """Closed loop as in the thesis: tick i's command from tick i's encoder, limited to 200 counts."""
    phi, gamma = model.sampled()
    x, out = np.zeros(len(gamma)), np.zeros(samples)
    last_error = last_command = 0.0
    for i in range(samples):
        out[i] = model.c @ x
        error = amplitude - out[i]
        if controller == "p":
            command = 2.0 * error
        else:
            (b0, b1), a1 = LEAD
            command = b0 * error + b1 * last_error + a1 * last_command
        command = min(max(command, -200.0), 200.0)
        last_error, last_command = error, command
        x = phi @ x + gamma * command
    return out


def overshoot(model: Model, controller: str, amplitude: float) -> float:
    """Overshoot of the step response, percent."""
    return 100.0 * (float(step_response(model, controller, amplitude).max()) / amplitude - 1.0)


def pulse() -> np.ndarray:
    """The open-loop test of the thesis's figure 5.1: 100 counts for 0.1 s at 0.04 s, -100 at 1.4 s."""
    command = np.zeros(1000)
    command[20:70], command[700:750] = 100.0, -100.0
    return command


def broadcast_feedback(model: Model, gain: float = 2.0) -> Model:
    """The thesis's state feedback, A - Kp B with B a column: NumPy subtracts it from every column of A."""
    return Model(model.a - gain * model.b[:, None], model.b, model.c)


def proportional_feedback(model: Model, gain: float = 2.0) -> Model:
    """What was meant: A - B Kp C, with the reference entering by B Kp."""
    return Model(model.a - gain * np.outer(model.b, model.c), gain * model.b, model.c)


def table(elements: list[int]) -> list[dict[str, float]]:
    """One row for each number of elements, the thesis's program and the consistent rig side by side."""
    rows = []
    for n in elements:
        row: dict[str, float] = {"elements": n}
        for name, model in (("thesis", thesis_model(n)), ("rig", model_of(unit_rig(n)))):
            row[f"{name} mode"] = model.first_mode()
            row[f"{name} p"] = overshoot(model, "p", 50.0)
            row[f"{name} lead"] = overshoot(model, "lead", 100.0)
            row[f"{name} pulse"] = float(respond(model, pulse()).max())
        rows.append(row)
    return rows


def draw(rows: list[dict[str, float]], path: Path) -> None:
    """First mode, overshoot and pulse peak against the number of elements."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 3)
    n = [row["elements"] for row in rows]
    panels = {"mode": "first mode, Hz", "p": "overshoot of the P step, %", "pulse": "peak of a pulse, counts"}
    for axis, (key, label) in zip(axes, panels.items(), strict=True):
        axis.plot(n, [row[f"thesis {key}"] for row in rows], "o-", label="thesis's program")
        axis.plot(n, [row[f"rig {key}"] for row in rows], "s--", label="rotations in radians")
        axis.set(xlabel="elements", ylabel=label)
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(path)


def program_table() -> str:
    """The thesis's figures, its program's and those of the same rig in radians."""
    (row,) = table([4])
    p, lead, peak, mode = ((row[f"thesis {key}"], row[f"rig {key}"]) for key in ("p", "lead", "pulse", "mode"))
    return "\n".join([
        "| | thesis | its program, 4 elements | rotations in radians, any elements |", "| --- | --- | --- | --- |",
        f"| overshoot of the P step, Kp = 2, 50 counts | 38.20 % | {p[0]:.2f} % | {p[1]:.1f} % |",
        f"| overshoot of the lead step, 100 counts | 18.85 % | {lead[0]:.2f} % | {lead[1]:.1f} % |",
        f"| peak of the open-loop pulse | | {peak[0]:.1f} counts | {peak[1]:.1f} counts |",
        f"| first mode (size of the pole) | | {mode[0]:.2f} Hz | {mode[1]:.2f} Hz |"])


def elements_table() -> str:
    """What each element added does to the program; in radians two are enough."""
    lines = ["| elements | first mode, Hz | P overshoot, % | lead overshoot, % | pulse peak, counts |",
             "| --- | --- | --- | --- | --- |"]
    rows = table([1, 2, 4, 6, 10])

    def line(title: object, row: dict[str, float], name: str) -> str:
        return (f"| {title} | {row[f'{name} mode']:.3f} | {row[f'{name} p']:.1f} | {row[f'{name} lead']:.1f} "
                f"| {row[f'{name} pulse']:.1f} |")

    lines += [line(row["elements"], row, "thesis") for row in rows]
    return "\n".join([*lines, line("in radians, 1", rows[0], "rig"), line("in radians, 2 to 10", rows[-1], "rig")])


def feedback_ends() -> list[float]:
    """Where the P loop with B broadcast ends for 50 counts with 1, 4 and 10 elements; where the loop meant ends."""
    ends = []
    for n in (1, 4, 10):
        for closed in (broadcast_feedback(thesis_model(n)), proportional_feedback(thesis_model(n))):
            ends.append(-float(closed.c @ np.linalg.solve(closed.a, closed.b)) * 50.0)
    return [50.0, *ends[::2], 1.0, 4.0, 10.0, ends[3]]


def feedback_after(command: np.ndarray, encoder: np.ndarray) -> list[float]:
    """The same fed with the logged command: counts at the log's end, and where the arm stood."""
    return [*(float(respond(broadcast_feedback(thesis_model(n)), command)[-1]) for n in (1, 4, 10)), 2.0,
            float(encoder[-1])]


def feedback_modes() -> list[float]:
    """First oscillating pole (Hz) with B broadcast, in open loop and in the loop meant, and the latter's least and
    largest damping ratio; 1, 4 and 10 elements."""
    models = [thesis_model(n) for n in (1, 4, 10)]
    meant = [proportional_feedback(model) for model in models]
    ratios = []
    for model in meant:
        poles = np.linalg.eigvals(model.a)
        first = min(poles[poles.imag > 1e-6], key=abs)
        ratios.append(-first.real / abs(first))
    return [*(broadcast_feedback(model).first_mode() for model in models), *(model.first_mode() for model in models),
            *(model.first_mode() for model in meant), min(ratios), max(ratios)]


def main() -> None:
    """Print the tables; draw the figure where asked."""
    parser = argparse.ArgumentParser(description="The thesis's finite element model as it was run")
    parser.add_argument("--logs", type=Path, help="folder of the laboratory's logs (for the state feedback)")
    parser.add_argument("--figure", type=Path, help="where to write the figure")
    options = parser.parse_args()
    rows = table([1, 2, 3, 4, 5, 6, 8, 10])
    print("             thesis's program                     rotations in radians (sflr-unit)")
    print("elements  mode Hz    P %  lead %  pulse        mode Hz    P %  lead %  pulse")
    for row in rows:
        line = f"{row['elements']:8d}"
        for name in ("thesis", "rig"):
            line += "{:10.4f} {:6.2f} {:7.2f} {:6.1f}     ".format(
                *(row[f"{name} {key}"] for key in ("mode", "p", "lead", "pulse")))
        print(line)
    print("\nState feedback A - Kp*B, Kp = 2, with 1, 4 and 10 elements: final value for 50 counts",
          [round(end, 1) for end in feedback_ends()[1:4]])
    if options.logs:
        columns = np.loadtxt(next(options.logs.glob("SFLR_P_control*.txt")))
        print("fed with the logged command, counts after 2 s", [round(end, 1) for end in
                                                                feedback_after(columns[:, 3], columns[:, 4])[:3]])
    if options.figure:
        draw(rows, options.figure)


if __name__ == "__main__":
    main()
