"""What the figures are made of: thinned lines, spectra, whiteness, labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from station.pictures.picture import Evidence
from station.view import figures, remaining
from station.view.labels import place_labels
from tests.view import made


def test_thinning_keeps_every_extreme() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(100_001) / 500.0
    y = rng.normal(size=t.size)
    y[[777, 50_003]] = 90.0, -80.0
    x, kept = figures.thin(t, y)
    assert len(kept) <= figures.MAX_POINTS + 2
    assert kept.max() == 90.0 and kept.min() == -80.0
    assert x[0] == t[0] and x[-1] == t[-1] and np.all(np.diff(x) > 0)
    assert np.all(y[np.searchsorted(t, x)] == kept)


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_a_residual_that_knows_nothing_of_the_command_stays_in_its_band_at_99_of_100_lags(colour: float) -> None:
    """Also where both are slow, which a band of white noise would take for a connection."""
    rng = np.random.default_rng(7)
    outside, naive = [], []
    for _ in range(300):
        error, command = (signal.lfilter([1.0], [1.0, -pole], rng.normal(size=1000)) for pole in (colour, 0.95))
        found = remaining.command_correlation(error, command)
        outside.append(np.mean(np.abs(found.values) > found.bound))
        naive.append(np.mean(np.abs(found.values) > remaining.BAND / np.sqrt(1000)))
    assert 0.002 <= np.mean(outside) <= 0.025
    assert colour == 0.0 or np.mean(naive) > 0.1


def test_a_residual_that_follows_the_command_leaves_the_band_at_its_lag_alone() -> None:
    rng = np.random.default_rng(8)
    command = rng.normal(size=2000)
    later = remaining.command_correlation(0.3 * np.roll(command, 7) + rng.normal(size=2000), command)
    assert later.lags[np.argmax(later.values)] == 7 and 1 <= later.outside <= 2 and later.asked == 25
    before = remaining.command_correlation(0.3 * np.roll(command, -7) + rng.normal(size=2000), command)
    assert before.lags[np.argmax(before.values)] == -7 and before.outside <= 1     # feedback accuses nobody
    still = remaining.command_correlation(np.ones(50), np.zeros(50))
    assert still.outside == 0 and not still.values.any()


def test_the_autocorrelation_is_what_its_definition_says() -> None:
    rng = np.random.default_rng(9)
    e = rng.normal(size=300)
    c = e - e.mean()
    found = remaining.whiteness(e)
    assert found.values == pytest.approx([c[k:] @ c[:-k] / (c @ c) for k in range(1, 26)])
    assert found.bound == pytest.approx(2.5758 / np.sqrt(300), rel=1e-4) and found.white


def test_an_even_line_says_its_places_once_and_whole_numbers_take_two_bytes() -> None:
    comparison = made.comparisons()[0]
    figure = figures.run_figure(comparison.run, figures.simulations(comparison))
    line = figure.data[0]
    assert line.x is None and (line.x0, line.dx) == (0.0, pytest.approx(0.002))
    assert line.y.dtype == np.int16 and np.all(line.y == made.comparisons()[0].run.encoder)
    uneven = figures._line(np.array([0.0, 1.0, 3.0]), np.array([0.5, 1.0, 2.0]), "before", "", "dash", 1.0)
    assert list(uneven.x) == [0.0, 1.0, 3.0] and uneven.y.dtype == np.float32


def test_the_law_is_weighed_against_the_medians_of_its_points() -> None:
    full = made.friction_evidence()
    assert figures.law_share(full) == pytest.approx(made.FRICTION / 0.0306, rel=0.05)
    at_rest = replace(full, x=np.append(full.x, np.zeros(9000)), y=np.append(full.y, np.zeros(9000)))
    assert figures.law_share(at_rest) == pytest.approx(made.FRICTION / 0.0306, rel=0.05)
    twice = replace(full, law_y=2.0 * np.asarray(full.law_y))
    assert figures.law_share(twice) == pytest.approx(0.5 * made.FRICTION / 0.0306, rel=0.05)
    assert figures.law_share(made.phase_evidence()) is None
    assert figures.law_share(replace(full, law_x=None, law_y=None)) is None


def test_a_picture_of_a_wrong_constant_shows_both_rigs_apart_without_colour() -> None:
    f = np.geomspace(1.0, 20.0, 12)
    contrast = Evidence("t", "frequency", "x", "y", f, -f, f, -f, "", -2.0 * f)
    measured, without, with_it = figures.evidence_figure(contrast).data
    assert (measured.mode, without.line.dash, with_it.line.dash) == ("markers", "dash", "solid")
    assert (without.name, with_it.name) == ("without the cause", "with the cause")
    assert np.allclose(without.y, -2.0 * f, rtol=1e-6) and np.allclose(with_it.y, -f, rtol=1e-6)


def test_white_noise_passes_and_a_slow_drift_fails() -> None:
    rng = np.random.default_rng(2)
    p_values = [remaining.whiteness(rng.normal(size=1000)).p_value for _ in range(200)]
    assert 0.02 <= np.mean(np.array(p_values) < 0.1) <= 0.2
    drift = rng.normal(size=1000) + 0.5 * np.sin(np.arange(1000) / 40.0)
    assert not remaining.whiteness(drift).white


def test_the_density_of_white_noise_is_its_power_over_the_band() -> None:
    rng = np.random.default_rng(3)
    frequency, density = figures._mean_density([rng.normal(0.0, 2.0, 200_000)], 500.0)
    assert np.sqrt(np.mean(density[1:-1] ** 2)) == pytest.approx(2.0 / np.sqrt(250.0), rel=0.02)
    assert frequency[0] > 0.0 and frequency[-1] == 250.0


def test_the_hero_is_what_the_diagnosis_says_is_wrong() -> None:
    comparison, channel = figures.hero_choice(made.result()) or (None, "")
    assert comparison is not None and (comparison.run.name, channel) == ("step-kp2", "encoder")
    other, _ = figures.hero_choice(made.result("nothing_missing")) or (None, "")
    assert other is not None and other.run.name == "pulse-open"       # the largest error


def test_lines_differ_without_colour() -> None:
    figure = figures.hero(made.comparisons()[0], "encoder")
    looks = {(trace.line.dash, trace.line.width) for trace in figure.data}
    assert len(looks) == len(figure.data) == 4
    assert {note.text for note in figure.layout.annotations} == \
        {"measured", "simulated before", "simulated after", "reference"}


def test_labels_keep_clear_of_each_other_and_of_the_frame() -> None:
    t = np.linspace(0.0, 2.0, 500)
    lines = {"before": np.exp(-t) * np.cos(20 * t), "measured": np.exp(-2 * t) * np.cos(20 * t),
             "after": np.exp(-2 * t) * np.cos(20 * t)}
    texts = {"before": "simulated before", "measured": "measured", "after": "simulated after"}
    places = place_labels(t, lines, texts, np.abs(lines["before"] - lines["measured"]))
    boxes = []
    for role, place in places.items():
        y = (0.05 + 0.9 * (1.0 - lines[role][place.index]) / (1.0 - min(line.min() for line in lines.values())))
        x = t[place.index] / 2.0 * 300 + place.shift - (7 * len(texts[role]) if place.shift < 0 else 0)
        boxes.append((x, y * 225 + place.drop, x + 7 * len(texts[role])))
    for i, (left, middle, right) in enumerate(boxes):
        assert left > -5 and right < 305
        assert all(abs(middle - m) >= 15 or right < a or b < left for a, m, b in boxes[i + 1:])


def test_a_large_cloud_shows_its_median_and_the_law_is_drawn() -> None:
    figure = figures.evidence_figure(made.friction_evidence())
    cloud, median, law = figure.data
    right = median.y[np.asarray(median.x) > 0.5]
    assert cloud.name == "measured" and np.all(np.abs(right + made.FRICTION) < 0.006)
    assert law.meta["role"] == "law" and figure.layout.yaxis.range[0] < -made.FRICTION
    assert figures.evidence_figure(made.phase_evidence()).layout.xaxis.type == "log"


def test_the_next_experiment_is_drawn_with_the_difference() -> None:
    prediction = made.prediction()
    figure = figures.prediction_figure(prediction)
    assert [trace.name for trace in figure.data] == ["no cause", "Coulomb friction at the motor", "difference"] * 2
    one, other, apart = figure.data[3:]
    assert np.allclose(apart.y, np.asarray(one.y) - np.asarray(other.y), atol=1e-4)
    assert one.line.dash != other.line.dash and figure.data[0].showlegend and not one.showlegend
    assert len(figures.prediction_figure(replace(prediction, accel=None)).data) == 3
    hostile = figures.prediction_figure(replace(prediction, names=("<b>", "</script>")))
    assert hostile.data[0].name == "&lt;b&gt;"
