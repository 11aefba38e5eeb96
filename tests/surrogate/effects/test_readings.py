"""What effects say of their parameters, against what they do to a signal."""

import math
from dataclasses import replace

import pytest
import torch

from surgisoft.surrogate.effects import Context, Quantity, Reading, in_words, make_effect
from tests.surrogate.effects.arms import FACTS, REST_MM, stir, variants

EFFECTS = variants()
NONE = torch.zeros(1, 0)


def with_amplitudes(effect, **values):
    """The effect with amplitudes set by name."""
    for name, value in values.items():
        effect.amplitudes()[name].data.copy_(torch.as_tensor(value))
    return effect


def values(effect, seconds=None):
    """Value of each reading by its words."""
    return {each.text: each.value for each in effect.readings(seconds)}


def loaded(*loads):
    """(1, 3) actuation of loads, 1 at full."""
    return (FACTS.high * torch.tensor(loads)).unsqueeze(0)


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_says_what_its_parameters_mean(name):
    """As many readings whatever the parameters are, and finite ones."""
    effect = EFFECTS[name]
    first = effect.readings(600.0)
    assert first
    moved = stir(make_effect(name.split("-")[0], FACTS, **effect.config()))
    for seconds in (None, 40.0, 600.0, 1e6):
        readings = moved.readings(seconds)
        assert len(readings) == len(first)
        assert all(math.isfinite(each.value) for each in readings)
        assert all(("{}" in each.text) != ("{+}" in each.text) for each in readings)
        assert "{" not in in_words(readings)


def test_a_gain_is_the_push_that_a_chamber_has_more():
    effect = with_amplitudes(make_effect("gain_mismatch", FACTS), gain=[0.1, -0.08, 0.0])
    pushed = effect.apply(loaded(1, 1, 1), NONE) / FACTS.high - 1
    said = list(values(effect).values())
    assert said == pytest.approx((100 * pushed)[0].tolist(), abs=1e-4)
    assert in_words(effect.readings()) == "push of chamber 1 +10 %, push of chamber 2 -8 %"


def test_a_shifted_zero_is_told_in_the_unit_of_the_actuation():
    effect = with_amplitudes(make_effect("zero_offset", FACTS), offset=[0.05, 0.0, -0.02])
    more = effect.apply(loaded(0, 0, 0), NONE) - loaded(0, 0, 0)
    assert list(values(effect).values()) == pytest.approx(more[0].tolist(), abs=1e-6)
    said = [f"zero of chamber {i} shifted by {more[0, i - 1]:+.2g} kPa" for i in (1, 3)]
    assert in_words(effect.readings()) == ", ".join(said)


@pytest.mark.parametrize("config", [{"pairs": True}, {"who": "next"}, {"who": "previous"}, {}])
def test_a_coupling_says_which_chamber_loses_to_which(config):
    """By the effect itself, with one chamber fully loaded, and with two."""
    effect = stir(make_effect("coupling", FACTS, **config), seed=1)
    after = {"next": 1, "previous": -1}
    for text, value in values(effect).items():
        numbers = [int(word) for word in text.split() if word.isdigit()]
        if numbers:
            own, other = (number - 1 for number in numbers)
        elif config.get("who", "none") in text:
            own, other = 0, after[config["who"]] % 3
        else:
            own, other = 0, -after.get(config.get("who"), 1) % 3
        loads = [0.0, 0.0, 0.0]
        loads[own] = loads[other] = 1.0
        lost = 1 - effect.apply(loaded(*loads), NONE)[0, own] / FACTS.high[own]
        assert value == pytest.approx(100 * float(lost.detach()), abs=1e-3)


@pytest.mark.parametrize("power", [1.0, 0.5])
def test_a_wall_that_yields_says_what_a_chamber_at_half_load_loses(power):
    """By the effect itself: chamber 1 at half load beside chamber 2 at full load."""
    effect = stir(make_effect("coupling", FACTS, who="beside", power=power), seed=1)
    two = replace(FACTS, low=FACTS.low[:2], high=FACTS.high[:2], rest=FACTS.rest[:2])
    pair = make_effect("coupling", two, who="beside", power=power)
    pair.load_state_dict(effect.state_dict())
    pushed = pair.apply(torch.tensor([[0.5, 1.0]]) * two.high, NONE)[0, 0]
    lost = 1 - float(pushed.detach()) / (0.5 * float(two.high[0]))
    (said,) = values(effect).items()
    assert said == (
        "a chamber at half load loses {} of its push to a fully loaded one beside it",
        pytest.approx(100 * lost, abs=1e-3),
    )


def test_a_body_that_softens_says_how_much_more_it_bends_stretches_and_sags():
    soft = make_effect("softening", FACTS, width=0.5, body="whole", weight=True)
    words = in_words(with_amplitudes(soft, own=0.2, common=0.1, sag=3.0).readings())
    assert words == (
        "where it was bent most, the body bends more by up to 20 %, "
        "where it was stretched most, the body stretches more by up to 10 %, "
        "as soft everywhere, held straight and level, it would sag 3 mm more"
    )


def test_a_body_that_creeps_says_how_much_more_it_bends_and_stretches():
    effect = make_effect("creep", FACTS, tau_s=1.0, width=0.1, body=True)
    words = in_words(with_amplitudes(effect, amount=0.2, stretch=-0.1).readings(300.0))
    assert words == (
        "bending under a load held for 300 s +20 %, stretch under a load held for 300 s -10 %, "
        "half of the creep comes within 0.68 s"
    )


def test_a_body_that_stiffens_says_how_much_less_it_bends_stretches_and_sags():
    stiff = make_effect("stiffening", FACTS, body="whole", full=0.25, weight=True)
    words = in_words(with_amplitudes(stiff, bend=0.2, own=0.1, sag=3.0).readings())
    assert words == (
        "bent by 29 degrees from base to tip, the body bends 20 % less, "
        "stretched by 5 %, it stretches 10 % less, "
        "as stiff everywhere, held straight and level, it would sag 3 mm less"
    )


def test_of_many_couplings_the_six_largest_are_told():
    """Six chambers have 30 of them: the largest first, and how many more there are."""
    six = replace(FACTS, low=torch.zeros(6), high=torch.full((6,), 100.0), rest=torch.zeros(6))
    effect = make_effect("coupling", six, pairs=True)
    shares = [0.01 * (20 + k) for k in range(30)]
    words = in_words(with_amplitudes(effect, linear=0.0, quadratic=shares).readings())
    said = words.split(", ")
    assert said[0] == "chamber 6 loses 49 % of its push to chamber 5"
    assert said[5] == "chamber 5 loses 44 % of its push to chamber 6"
    assert said[6:] == ["and 24 smaller ones"]
    few = [*shares[:6], *[0.0] * 24]
    assert in_words(with_amplitudes(effect, quadratic=few).readings()).count("chamber") == 12


def test_a_dead_zone_says_the_push_that_is_lost_far_from_rest():
    effect = with_amplitudes(
        make_effect("dead_zone", FACTS, width=0.001, each=True), threshold=[0.1, 0.0, 0.04]
    )
    lost = (loaded(1, 1, 1) - effect.apply(loaded(1, 1, 1), NONE))[0]
    assert list(values(effect).values()) == pytest.approx(lost.tolist(), rel=1e-3)
    words = "chamber 1 loses 5 kPa of its push, chamber 3 loses 2 kPa of its push"
    assert in_words(effect.readings()) == words


@pytest.mark.parametrize("kind", ["base", "actuation", "temperature"])
def test_a_drift_says_of_what_and_how_much_over_the_recording(kind):
    effect = make_effect("drift", FACTS, kind=kind, tau_s=400.0)
    after = torch.tensor([[10.0 if kind == "temperature" else 300.0]])
    if kind == "base":
        with_amplitudes(effect, turn=[0.0, 0.0, 0.1], shift=[0.0, -2.0, 0.0])
        at = torch.tensor([[[10.0, 0.0, 0.0]]])
        moved = effect.apply(at, after)[0, 0]
        said = values(effect, 300.0)
        turned = math.degrees(math.atan2(float(moved[1] - said_of(said, "along y")), moved[0]))
        assert said_of(said, "about z") == pytest.approx(turned, rel=1e-3)
        zero = effect.apply(torch.zeros(1, 1, 3), after)[0, 0]
        assert said_of(said, "along y") == pytest.approx(float(zero[1]), rel=1e-5)
        assert "in 300 s" in in_words(effect.readings(300.0))
        return
    chambers = 1 if kind == "temperature" else 3
    gain = [0.0, -0.3, 0.0][:chambers] if chambers > 1 else [-0.3]
    with_amplitudes(effect, gain=gain, offset=[0.0, 0.0, 0.1])
    change = (effect.apply(loaded(1, 1, 0), after) - loaded(1, 1, 0))[0]
    said = values(effect, 300.0)
    one = "gain {+}" if chambers == 1 else "gain of chamber 2"
    assert said_of(said, one) == pytest.approx(100 * float(change[1] / FACTS.high[1]), rel=1e-4)
    assert said_of(said, "offset of chamber 3") == pytest.approx(float(change[2]), rel=1e-4)
    assert "chamber 1" not in in_words(effect.readings(300.0))


def said_of(said, words):
    """The value of the reading with these words."""
    return next(value for text, value in said.items() if words in text)


def test_a_drift_of_hours_is_steady_however_long_its_time_constant():
    """Intervals draw time constants beyond all bounds."""
    effect = with_amplitudes(make_effect("drift", FACTS, power=0.5), turn=[0.1, 0.0, 0.0])
    for log_tau, share in ((80.0, 0.5), (4000.0, 0.5), (-4000.0, 1.0)):
        effect.log_tau.data.fill_(log_tau)
        said = said_of(values(effect, 150.0), "about x")
        assert said == pytest.approx(math.degrees(0.1 * share), rel=1e-3)


def test_creep_says_what_a_held_load_adds_and_when_half_of_it_has_come():
    effect = with_amplitudes(make_effect("creep", FACTS, tau_s=200.0, width=0.2), amount=0.3)

    def grown(seconds):
        memory = effect.rest(torch.zeros(1, 3))
        memory = effect.advance(memory, loaded(1, 0, 0), Context(torch.tensor([seconds])))
        return float(effect.apply(loaded(1, 0, 0), memory)[0, 0] / FACTS.high[0] - 1)

    more, half = values(effect, 300.0).values()
    assert more == pytest.approx(100 * grown(300.0), rel=1e-4)
    assert 2 * grown(half) == pytest.approx(grown(300.0), rel=1e-3)


def test_a_wall_that_stiffens_or_softens_says_how_much_push_goes_or_comes():
    """A cubic spring takes its share at full load; Mullins' damage of chamber 1 at half load."""
    stiff = make_effect("stiffening", replace(FACTS, low=0 * FACTS.low), steepness=1e-3)
    alone, together = values(with_amplitudes(stiff, own=0.2, bend=0.05)).values()
    assert (alone, together) == pytest.approx((25.0, 20.0), abs=0.05)
    soft = make_effect("softening", FACTS, width=0.2, growth=1e-6)
    (more,) = values(with_amplitudes(soft, own=0.1, common=0.0)).values()
    assert more == pytest.approx(100 * 0.1 * -math.expm1(-0.75 / 0.2), rel=1e-3)


def test_hysteresis_says_the_width_of_its_loop():
    """A play operator of radius r and weight w on each chamber's line: the loop is 2 w r wide."""
    effect = make_effect("hysteresis", FACTS, radii=(0.2,), pairs=False)
    for chamber in range(3):
        effect.weight.data[chamber, chamber, 0] = 0.5
    half = float((FACTS.high - FACTS.low).mean()) / 2
    (wide,) = values(effect).values()
    assert wide == pytest.approx(2 * 0.5 * 0.2 * half, rel=1e-4)
    assert in_words(effect.readings()).startswith("loop of 5.3 kPa between loading and unloading")
    effect.weight.data.mul_(-1.0)  # a lead is no loop
    assert in_words(effect.readings()) == ""


def test_twist_payload_and_misalignment_say_angles_and_millimetres():
    twist = with_amplitudes(make_effect("twist", FACTS), linear=0.2, quadratic=0.1)
    assert list(values(twist).values()) == pytest.approx([math.degrees(0.3)], rel=1e-5)
    level = replace(FACTS, gravity=(1.0, 0.0, 0.0))
    payload = with_amplitudes(make_effect("payload", level), tip_sag=2.0, body_sag=1.0)
    sunk = float(payload.apply(REST_MM.unsqueeze(0), NONE)[0, -1, 0])
    assert list(values(payload).values()) == pytest.approx([sunk], rel=0.02)
    frame = make_effect("misalignment", FACTS)
    with_amplitudes(frame, turn=[0.0, 0.05, 0.0], shift=[0.0, 0.0, 3.0], scale=0.0)
    words = "frame turned by +2.9 degrees about y, shifted by +3 mm along z"
    assert in_words(frame.readings()) == words


def test_lags_say_their_time_constants_and_contact_its_place():
    lag = make_effect("line_lag", FACTS, up_s=0.3, down_s=0.6)
    words = "time constant of a rise 0.3 s, time constant of a fall 0.6 s, 80 % of the command lags"
    assert in_words(with_amplitudes(lag, share=0.8).readings()) == words
    viscous = with_amplitudes(make_effect("rate_dependence", FACTS, tau_s=0.15), share=1.6)
    assert in_words(viscous.readings()) == "time constant 0.15 s"  # 160 % of a load is no share
    swing = with_amplitudes(
        make_effect("inertia", FACTS, frequency_Hz=1.5, damping=0.25), share=1.0
    )
    assert in_words(swing.readings()).startswith("swings at 1.5 Hz, damping ratio 0.25, 100 %")
    wall = with_amplitudes(make_effect("contact", FACTS, point=2, offset_mm=12.0), share=0.5)
    assert in_words(wall.readings()) == (
        "support of key point k2 by a plane with the normal (1.00, 0.00, 0.00), 12 mm from the "
        "base along the normal, it pushes 50 % of the depth back"
    )


def test_the_key_point_of_a_contact_is_counted_from_0_as_in_recordings():
    count = len(FACTS.rest_mm)
    for given, point in ((0, 0), (-1, count - 1), (count - 2, count - 2)):
        wall = make_effect("contact", FACTS, point=given)
        known = {quantity.name: quantity for quantity in wall.quantities()}["key_point"]
        assert (known.value, known.low, known.high) == (point, 0, count - 1)
        assert f"key point k{point} " in wall.readings()[0].text


def test_a_sentence_leaves_out_what_recordings_do_not_determine():
    gain = Reading("gain {+}", -50.0, "%", size=0.5, signed=True)
    small = Reading("offset {+}", 3.0, "kPa", size=0.1, signed=True)
    tau = Reading("time constant {}", 12345.6, "s")
    assert in_words([gain, small, tau]) == "gain -50 %, time constant 12000 s"
    sure = [(-52.0, -48.2), (1.0, 5.0), (12000.0, 13000.0)]
    assert in_words([gain, small, tau], sure) == (
        "gain -50 % (95 %: -52 to -48.2), offset +3 kPa (95 %: +1 to +5), "
        "time constant 12300 s (95 %: 12000 to 13000)"
    )
    assert in_words([gain, small, tau], [(-90.0, 1.0), (-1.0, 5.0), (1.0, 1e9)]) == ""
    nan = math.nan
    assert in_words([gain, tau], [(nan, nan), (nan, nan)]) == ""
    held = [(-50.0, -50.0), (3.0, 3.0), (12345.6, 12345.6)]  # a fit without intervals
    assert in_words([gain, small, tau], held) == "gain -50 %, time constant 12300 s"


def test_an_effect_of_a_user_says_its_single_numbers():
    effect = EFFECTS["twist"]
    said = super(type(effect), effect).readings()
    assert [each.text for each in said] == ["linear {}", "quadratic {}", "half load {}"]
    assert [each.unit for each in said] == ["rad", "rad", "rad"]


def test_an_effect_of_a_user_says_a_number_of_each_chamber_in_front_of_the_network():
    gains = with_amplitudes(make_effect("gain_mismatch", FACTS), gain=[0.25, -0.5, 0.0])
    said = super(type(gains), gains).readings()
    assert in_words(said) == "gain share of chamber 1 +0.25, gain share of chamber 2 -0.5"
    assert len(said) == 3


def test_times_of_an_effect_of_a_user_are_not_told_as_those_of_chambers():
    """Three times of a spectrum on an arm of three chambers: their range lacks zero."""

    class Spectrum(type(make_effect("gain_mismatch", FACTS))):
        def quantities(self):
            return [Quantity("tau_s", [1.0, 20.0, 300.0], "s", 0.1, 2000.0, "three elements")]

    effect = Spectrum(FACTS)
    assert super(type(make_effect("gain_mismatch", FACTS)), effect).readings() == []


def test_an_effect_of_a_user_says_a_number_of_each_axis_behind_the_network():
    """The shift lies half as far in its plausible range as the turn, and is told beside it."""
    moved = make_effect("misalignment", FACTS)
    turn, shift = (each for each in moved.quantities() if each.name in ("turn_rad", "shift_mm"))
    moved = with_amplitudes(moved, turn=[0.0, turn.high, 0.0], shift=[shift.high / 2, 0.0, 0.0])
    said = in_words(super(type(moved), moved).readings())
    assert f"turn along y +{turn.high:.2g} rad" in said
    assert f"shift along x +{shift.high / 2:.2g} mm" in said
    assert " along z " not in said


def test_push_that_is_not_lost_is_gained():
    """A negative loss is told as a gain, with the ends of its interval turned round."""
    loss = Reading("chamber 4 loses {} of its push", 7.2, "%", signed=True, instead="it gains {}")
    gain = replace(loss, value=-7.2)
    assert loss.said((5.0, 9.0)) == "chamber 4 loses 7.2 % (95 %: 5 to 9) of its push"
    assert gain.said((-9.0, -5.0)) == "it gains 7.2 % (95 %: 5 to 9)"
    assert gain.said() == "it gains 7.2 %"
    wall = make_effect("coupling", FACTS, pairs=True)
    with torch.no_grad():
        for parameter in wall.amplitudes().values():
            parameter.fill_(-0.05)
    assert in_words(wall.readings()).startswith("chamber 1 gains 10 % of push from chamber 2, ")
    dead = with_amplitudes(make_effect("dead_zone", FACTS, each=True), threshold=[-0.1, 0.0, 0.1])
    told = in_words(dead.readings())
    assert told.startswith("chamber 1 gains ")
    assert ", chamber 3 loses " in told
