"""Protocols: what they visit, what they excite, and files of one's own."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.measurement.protocols import (
    PROTOCOLS,
    SIGNALS,
    Knots,
    Protocol,
    load_schedule,
    make_protocol,
)

LIMITS = np.tile([-15.0, 54.0], (3, 1))
LATTICE = -15.0 + 3.0 * np.arange(24)


def directions(protocol):
    """(T, m) sign of each chamber's last change, as a model's direction input keeps it; 0: none."""
    held = np.zeros_like(protocol.commands)
    for _, rows in protocol.run_rows:
        p = protocol.commands[rows]
        last = np.zeros(p.shape[1])
        for t in range(len(p)):
            change = np.sign(p[t] - p[t - 1]) if t else np.sign(p[t])
            last = np.where(change != 0, change, last)
            held[rows.start + t] = last
    return held


def rising_shares(protocol, least=20):
    """Share of rising approaches of each chamber in each cell of 4 x 4 x 4 cells (cells, m)."""
    cell = np.clip(((protocol.commands + 15.0) / 69.0001 * 4).astype(int), 0, 3)
    cell = cell @ [16, 4, 1]
    up = directions(protocol) > 0
    shares = [up[cell == c].mean(axis=0) for c in range(64) if (cell == c).sum() >= least]
    return np.array(shares)


@pytest.mark.parametrize("name", ["grid", "traverse"])
def test_lattice_of_the_paper_is_visited_once(name):
    """24 levels of 3 kPa a chamber: 13,824 points, each once (Chen et al. 2025, sec. III-B)."""
    protocol = make_protocol(name, LIMITS)
    assert protocol.kind == "settled"
    assert (protocol.settle_s, protocol.average_s) == (3.0, 1.0)
    assert protocol.commands.shape == (13824, 3)
    levels = np.round((protocol.commands + 15.0) / 3.0).astype(int)
    np.testing.assert_allclose(protocol.commands, LATTICE[levels], atol=1e-9)
    assert len(np.unique(levels, axis=0)) == 13824


def test_traverse_is_the_trap():
    """The slow chamber only ever rises, and moves by one level at a time like the others."""
    protocol = make_protocol("traverse", LIMITS)
    steps = np.diff(protocol.commands, axis=0)
    assert (steps[:, 0] >= 0).all()
    assert np.abs(steps).sum(axis=1) == pytest.approx(3.0)
    assert len(protocol.run_rows) == 1
    shares = rising_shares(protocol)
    assert (shares[16:, 0] == 1.0).all()  # but for the lowest quarter, reached from ambient


def test_grid_excites_direction_at_every_position():
    """In every cell of the cube each chamber was approached from both sides."""
    shares = rising_shares(make_protocol("grid", LIMITS))
    assert len(shares) == 64
    assert shares.min() > 0.08
    assert shares.max() < 0.92
    assert np.quantile(shares, 0.05) > 0.2
    assert np.quantile(shares, 0.95) < 0.8
    assert np.abs(shares.mean(axis=0) - 0.5).max() < 0.1


def test_grid_makes_every_chamber_the_slow_one_both_ways():
    """Slow passes: a chamber that changes rarely, and then by one level in the same direction."""
    protocol = make_protocol("grid", LIMITS)
    steps = np.diff(protocol.commands, axis=0)
    for chamber in range(3):
        moves = np.flatnonzero(np.abs(np.abs(steps[:, chamber]) - 3.0) < 1e-9)
        slow = [
            (a, b) for a, b in itertools.pairwise(moves)
            if b - a >= 12 and steps[a, chamber] * steps[b, chamber] > 0
            and np.abs(steps[a + 1 : b]).max() < 3.1
        ]  # fmt: skip
        signs = np.sign([steps[a, chamber] for a, _ in slow])
        assert (signs > 0).sum() > 12
        assert (signs < 0).sum() > 12


def test_grid_reverses_at_varied_amplitudes():
    """Between turning points of a chamber lie all distances from 6 kPa to the whole range."""
    p = make_protocol("grid", LIMITS).commands
    for chamber in range(3):
        moved = p[np.flatnonzero(np.diff(p[:, chamber], prepend=np.nan) != 0), chamber]
        turns = moved[1:-1][np.diff(np.sign(np.diff(moved))) != 0]
        reach = np.abs(np.diff(turns))
        counts, _ = np.histogram(reach, [2, 10, 20, 30, 40, 50, 60, 70])
        assert (counts > 5).all()


def test_walk_stays_on_the_lattice_and_excites():
    protocol = make_protocol("walk", LIMITS)
    steps = np.diff(protocol.commands, axis=0)
    inside = np.diff(protocol.run) == 0
    assert np.abs(steps[inside]).max() == pytest.approx(3.0)
    shares = rising_shares(protocol)
    assert len(shares) > 55
    assert np.quantile(shares, 0.05) > 0.1
    assert np.quantile(shares, 0.95) < 0.9
    assert len(protocol.run_rows) == 8


def test_validation_and_test_are_other_distributions():
    """Off the lattice, different from the grid and from each other (Kolmogorov-Smirnov)."""
    from scipy.stats import ks_2samp

    sets = {name: make_protocol(name, LIMITS).commands for name in ("grid", "validation", "test")}
    assert len(sets["validation"]) == len(sets["test"]) == 1000
    for name in ("validation", "test"):
        off = np.abs((sets[name] + 15.0) / 3.0 % 1 - 0.5) < 0.49
        assert off.mean() > 0.9
        assert (sets[name].max(axis=0) - sets[name].min(axis=0) > 55).all()
    for one, other in (("grid", "validation"), ("grid", "test"), ("validation", "test")):
        steps = [np.linalg.norm(np.diff(sets[k], axis=0), axis=1) for k in (one, other)]
        assert ks_2samp(*steps).pvalue < 1e-4
    centre = [np.abs(sets[k] - 19.5).mean() for k in ("validation", "test")]
    assert abs(centre[0] - centre[1]) > 1.0


@settings(max_examples=25, deadline=None)
@given(
    name=st.sampled_from(sorted(PROTOCOLS)),
    points=st.integers(10, 400),
    seed=st.integers(0, 1000),
    chambers=st.integers(1, 4),
)
def test_every_protocol_scales_and_keeps_the_limits(name, points, seed, chambers):
    limits = np.tile([-10.0, 40.0], (chambers, 1))
    limits[0] = [0.0, 30.0]
    protocol = make_protocol(name, limits, points, seed)
    low, high = limits.T
    assert (protocol.commands >= low - 1e-9).all()
    assert (protocol.commands <= high + 1e-9).all()
    samples = sum(len(protocol.commands_at(rows, 0.05)) for _, rows in protocol.run_rows)
    assert samples == points
    again = make_protocol(name, limits, points, seed)
    np.testing.assert_array_equal(again.commands, protocol.commands)
    if name == "grid":
        assert len(np.unique(protocol.commands.round(9), axis=0)) == points


RANGES = st.tuples(st.floats(-200.0, 200.0), st.floats(1.0, 30.0)).map(lambda r: (r[0], sum(r)))
"""Ranges of vacuum (both ends below zero), of pressure that never ends, and of both [kPa]."""


@settings(max_examples=8, deadline=None)
@given(limits=st.lists(RANGES, min_size=1, max_size=3), seed=st.integers(0, 1000))
def test_every_signal_moves_every_chamber_within_any_range(limits, seed):
    """25 minutes begin at rest and use at least a fifth of any range; `returns` has two postures
    only, which may be near rest."""
    low, high = np.array(limits).T
    for name, signal in SIGNALS.items():
        knots = Knots(np.array(limits))
        signal.draw(knots, 1500.0, np.random.default_rng(seed))
        times, rows = knots.cut(1500.0)
        assert times[-1] == 1500.0
        assert (rows >= low - 1e-9).all()
        assert (rows <= high + 1e-9).all()
        least = 0.0 if name == "returns" else 0.2
        assert (np.ptp(rows, axis=0) > least * (high - low)).all()
        np.testing.assert_array_equal(rows[0], np.clip(0.0, low, high))


@settings(max_examples=8, deadline=None)
@given(limits=st.lists(RANGES, min_size=1, max_size=3), seed=st.integers(0, 1000))
def test_every_protocol_moves_every_chamber_within_any_range(limits, seed):
    low, high = np.array(limits).T
    for name, entry in PROTOCOLS.items():
        points = 1000 if entry.steady_state else 24_000
        commands = make_protocol(name, np.array(limits), points, seed).commands
        assert (commands >= low - 1e-9).all()
        assert (commands <= high + 1e-9).all()
        assert (np.ptp(commands, axis=0) >= 0.2 * (high - low)).all()


@pytest.mark.parametrize("name", ["ramps", "two_speeds", "long_holds", "returns", "ladder", "sets"])
def test_vacuum_mirrors_pressure(name):
    """An arm of -60 to 0 kPa is driven as one of 0 to 60 kPa is, with the other sign."""

    def rows(limits):
        knots = Knots(np.array(limits))
        SIGNALS[name].draw(knots, 300.0, np.random.default_rng(4))
        return knots.cut(300.0)

    (times, pushed), (same, drawn) = rows([[0.0, 60.0]] * 2), rows([[-60.0, 0.0]] * 2)
    np.testing.assert_allclose(same, times)
    np.testing.assert_allclose(drawn, -pushed)


@pytest.mark.parametrize("name", ["two_speeds", "long_holds", "ladder"])
def test_the_farther_end_of_a_range_is_the_one_that_is_used(name):
    """From -60 to 5 kPa the arm goes far below ambient, from -15 to 54 kPa far above it."""
    for low, high in ((-60.0, 5.0), (-15.0, 54.0)):
        knots = Knots(np.array([[low, high]]))
        SIGNALS[name].draw(knots, 600.0, np.random.default_rng(0))
        farthest = max(knots.cut(600.0)[1].ravel(), key=abs)
        assert abs(farthest) > 0.8 * max(-low, high)
        assert np.sign(farthest) == np.sign(low + high)


@pytest.mark.parametrize("chambers", [8, 10, 14])
def test_grid_of_many_chambers_visits_its_lattice_once(chambers):
    """8! orders with 2^8 directions would be ten million."""
    points = 2**chambers
    commands = make_protocol("grid", [[0.0, 1.0]] * chambers, points).commands
    assert len(np.unique(commands, axis=0)) == points
    assert set(np.unique(commands)) == {0.0, 1.0}


@pytest.mark.parametrize("name", ["grid", "traverse"])
def test_a_lattice_that_is_too_large_is_refused(name):
    """2^22 points of 22 chambers, and five levels of 13 chambers."""
    for chambers, points, says in (
        (22, 100, r"2 levels for each of 22 chambers has 4.19e\+06 set-points, expected at most"),
        (13, 10**9, r"5 levels for each of 13 chambers has 1.22e\+09 set-points, expected at most"),
    ):
        with pytest.raises(InputError, match=says):
            make_protocol(name, [[0.0, 50.0]] * chambers, points)


def test_limits_that_are_no_ranges_get_one_line():
    for limits in ([[0.0, 0.0]], [[5.0, 1.0]], [[0.0, np.nan]], [0.0, 1.0], np.zeros((0, 2))):
        with pytest.raises(InputError, match="expected a finite lowest and highest actuation"):
            make_protocol("walk", limits)
    with pytest.raises(InputError, match=r"widest range is 0.001, expected at least 0.1; state"):
        make_protocol("ramps", [[0.0, 1e-3]])


def test_ramps_have_their_rates():
    protocol = make_protocol("ramps", LIMITS)
    seconds, change = np.diff(protocol.t_s), np.abs(np.diff(protocol.commands, axis=0)).max(axis=1)
    rates = np.unique((change / seconds).round(6))
    np.testing.assert_allclose(rates, [2, 4, 8, 16], atol=1e-5)


def test_ladder_grows_and_shrinks():
    """Peaks from ambient of one ladder: rising to the limit, then falling."""
    protocol = make_protocol("ladder", LIMITS)
    peaks = protocol.commands.max(axis=1)[1:22:2]
    assert peaks.argmax() == 5
    assert (np.diff(peaks[:6]) > 0).all()
    assert (np.diff(peaks[5:]) < 0).all()
    assert peaks.max() == pytest.approx(54.0)


def test_reversals_are_small_and_holds_are_long():
    steps = np.abs(np.diff(make_protocol("reversals", LIMITS).commands, axis=0)).max(axis=1)
    assert np.median(steps) < 12.0
    holds = make_protocol("holds", LIMITS)
    still = np.abs(np.diff(holds.commands, axis=0)).max(axis=1) == 0
    lengths = np.diff(holds.t_s)[still]
    assert (lengths > 4.9).sum() >= 8
    assert lengths.max() > 15


def test_command_is_linear_between_rows():
    protocol = Protocol("p", "continuous", [[0.0], [10], [10]], [0, 0, 0], [0.0, 1.0, 1.5])
    at = protocol.commands_at(slice(0, 3), 0.25)[:, 0]
    np.testing.assert_allclose(at, [0, 2.5, 5, 7.5, 10, 10])


def test_schedule_file(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("t_s,c1_kPa,c2_kPa,run\n0,0,0,0\n2,10,-5,0\n0,0,0,1\n1,3,3,1\n")
    protocol = make_protocol(path, LIMITS[:2])
    assert (protocol.name, protocol.kind, protocol.unit) == ("mine", "continuous", "kPa")
    np.testing.assert_array_equal(protocol.commands, [[0, 0], [10, -5], [0, 0], [3, 3]])
    assert [run for run, _ in protocol.run_rows] == [0, 1]
    with pytest.raises(InputError, match="--points"):
        make_protocol(path, LIMITS[:2], 100)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("t_s,c1_kPa\n0,1\n", "1 rows, a schedule needs at least two"),
        ("t_s,c1_kPa\n0,1\n1,x\n", "line 3, column 'c1_kPa': got 'x', expected a number"),
        ("t_s,c1_kPa\n0,1\n1\n", "line 3: 1 cells, expected 2 as in the header"),
        ("t_s,c1_kPa\n0,1\n0,2\n", "time does not increase at row 2"),
        ("t_s,c1_kPa,c1_kPa\n0,1,1\n1,2,2\n", "column c1_kPa appears twice"),
        ("t_s,c1_kPa,c2_psi\n0,1,1\n1,2,2\n", "commands in kPa, psi, expected one unit"),
        ("t_s,c1_kPa,c3_kPa\n0,1,1\n1,2,2\n", "expected t_s, c1_kPa ... cm_kPa"),
        ("time,c1_kPa\n0,1\n1,2\n", "unknown column 'time'"),
        ("t_s,c1_kPa,run\n0,1,0\n1,1,1\n2,1,0\n", "a run appears again after another run"),
        ("t_s,c1_kPa,run\n0,1,0\n1,1,0.5\n", "run has a value that is not a whole number"),
    ],
)
def test_bad_schedules_get_one_line(tmp_path, text, says):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_schedule(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)


def test_bad_names_and_sizes_get_one_line(tmp_path):
    with pytest.raises(InputError, match="unknown protocol 'gird': known are"):
        make_protocol("gird", LIMITS)
    with pytest.raises(InputError, match="--points is 3, expected at least 10"):
        make_protocol("grid", LIMITS, 3)
    with pytest.raises(InputError, match="cannot be read"):
        load_schedule(tmp_path / "none.csv")


def test_a_schedule_with_a_channel_of_thousands_of_digits(tmp_path):
    (tmp_path / "s.csv").write_text(f"t_s,c{'1' * 5000}_kPa\n0,1\n1,2\n")
    with pytest.raises(InputError, match="unknown column"):
        load_schedule(tmp_path / "s.csv")
