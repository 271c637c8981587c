"""The identifier in force answers while another is made beside it."""

import json
import threading
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.pipeline.messages import FrameRequest
from starhil.emulator.sensor.pipeline.pipeline import Pipeline
from starhil.emulator.sensor.pipeline.star_identifiers import StarIdentifiers, StarIdentifierSetup
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA
from starid.errors import StaridError
from tests.waiting import PATIENCE_S

DEEP = StarIdentifierSetup("geometric", DEFAULT_CAMERA, 1.0, (("limiting_magnitude", 6.0),))
SHALLOW = replace(DEEP, options=(("limiting_magnitude", 5.0),))
WIDE = replace(DEEP, margin=2.0)
ACCURACY_ARCSEC = 20.0


@dataclass
class Made:
    """Stands for an identifier."""

    choice: StarIdentifierSetup


class Factory:
    """Makes what stands for identifiers: at once, or when it is let go."""

    def __init__(self) -> None:
        self.made: list[StarIdentifierSetup] = []
        self.go = threading.Event()
        self.go.set()
        self.ended = threading.Semaphore(0)

    def __call__(self, choice):
        assert self.go.wait(PATIENCE_S)
        self.made.append(choice)
        try:
            if dict(choice.options)["limiting_magnitude"] < 0.0:
                raise StaridError("too few stars")
            return Made(choice)
        finally:
            self.ended.release()

    def wait_for_thread(self) -> None:
        assert self.ended.acquire(timeout=PATIENCE_S)
        for thread in threading.enumerate():
            if thread.name == "identifier":
                thread.join(PATIENCE_S)


@pytest.fixture
def factory():
    return Factory()


@pytest.fixture
def beside(factory):
    """Star identifiers with the deep one in force, the factory held."""
    identifiers = StarIdentifiers(factory, in_background=True)
    assert identifiers.get(DEEP) == (Made(DEEP), True)  # the first is waited for
    factory.ended.acquire()
    factory.go.clear()
    return identifiers


def test_the_old_one_answers_until_the_new_one_is_ready(factory, beside):
    for _ in range(3):
        assert beside.get(SHALLOW) == (Made(DEEP), False)
    factory.go.set()
    factory.wait_for_thread()
    assert beside.get(SHALLOW) == (Made(SHALLOW), True)
    assert factory.made == [DEEP, SHALLOW]


def test_only_the_last_wish_is_made_after_the_one_under_way(factory, beside):
    assert beside.get(SHALLOW) == (Made(DEEP), False)
    assert beside.get(WIDE) == (Made(DEEP), False)
    factory.go.set()
    factory.wait_for_thread()
    assert beside.get(WIDE) == (Made(SHALLOW), False)
    factory.wait_for_thread()
    assert beside.get(WIDE) == (Made(WIDE), True)


def test_one_built_at_once_discards_the_build_in_the_background(factory, beside):
    assert beside.get(SHALLOW) == (Made(DEEP), False)
    factory.go.set()
    assert beside.build(WIDE) == Made(WIDE)
    factory.wait_for_thread()
    factory.wait_for_thread()
    assert beside.get(WIDE) == (Made(WIDE), True)


def test_returning_to_the_current_solver_takes_no_time(factory, beside):
    assert beside.get(SHALLOW) == (Made(DEEP), False)
    assert beside.get(DEEP) == (Made(DEEP), True)
    factory.go.set()


def test_a_solver_that_cannot_be_made_is_rejected_until_another_is_requested(factory, beside):
    impossible = replace(DEEP, options=(("limiting_magnitude", -1.0),))
    assert beside.get(impossible) == (Made(DEEP), False)
    factory.go.set()
    factory.wait_for_thread()
    for _ in range(2):
        with pytest.raises(StaridError, match="too few stars"):
            beside.get(impossible)
    assert factory.made == [DEEP, impossible]
    assert beside.get(DEEP) == (Made(DEEP), True)


def test_without_a_thread_each_one_is_waited_for(factory):
    identifiers = StarIdentifiers(factory, in_background=False)
    for choice in (DEEP, SHALLOW, SHALLOW, DEEP):
        assert identifiers.get(choice) == (Made(choice), True)
    assert factory.made == [DEEP, SHALLOW, DEEP]


@pytest.mark.parametrize(
    ("algorithm", "option", "value", "said"),
    [
        (
            "geometric",
            "nonsense",
            1,
            r"identifier\.nonsense: not an option of the algorithm geometric; known: blend_px, cache",
        ),
        ("geometric", "catalog", 1, "not an option"),
        ("geometric", "blend_px", "x", r"identifier\.blend_px: must be a number \(given: 'x'\)"),
        ("geometric", "blend_px", True, r"must be a number \(given: True\)"),
        ("lsi", "neighbours", 2.5, r"must be a whole number \(given: 2.5\)"),
        ("lsi", "solver", 3, r"must be one of 'exact', 'matlab', 'sklearn' \(given: 3\)"),
        ("lsi", "neighbours", 0, "must be at least 1, not 0"),
        ("lsi", "overlap", float("nan"), "must be a finite number"),
        ("rsi", "gamma_min_deg", "x", "must be a number"),
        ("geometric", "fov_tolerance", 2.0, "must be 0…0.3, not 2.0"),
        ("rsi", "magnitude_sigma", "x", r"must be a number \(given: 'x'\)"),
    ],
)
def test_an_option_that_the_algorithm_does_not_have_is_named(algorithm, option, value, said):
    with pytest.raises(EmulatorError, match=said):
        load_profile(
            "ideal", [f"run.algorithm={algorithm}", f"identifier.{option}={json.dumps(value).lower()}"]
        )


@pytest.mark.long
def test_frames_are_solved_while_another_index_is_built_and_then_the_new_limit_holds():
    profile = Profile.model_validate({"identifier": {"cache": False}, "catalog": {"epoch": 2026.0}})
    setup = replace(pipeline_setup(profile), build_in_background=True)
    pipeline = Pipeline(setup)
    magnitude = dict(zip(pipeline.catalog.hip.tolist(), pipeline.catalog.v.tolist(), strict=True))
    truth = Attitude.from_radec_roll(83.8, -1.2, 0.0)
    frame = FrameRequest(0, TruthState(truth, ZERO_RATE), 0.1, 1.0, setup.settings)
    bright = replace(frame, settings=replace(frame.settings, limiting_magnitude=4.0))

    def solve(request):
        result = pipeline.handle(request)
        assert result.valid, result
        error = Attitude(np.array(result.quaternion_xyzw)).error_to(truth)
        assert error.cross_boresight_arcsec < ACCURACY_ARCSEC
        return result

    before = solve(frame)
    assert not before.index_pending
    meanwhile = solve(bright)
    assert meanwhile.index_pending
    assert meanwhile.matched == before.matched
    begin = time.monotonic()
    while (after := solve(bright)).index_pending:
        assert time.monotonic() - begin < PATIENCE_S
    assert after.matched < before.matched
    assert max(magnitude[star.hip] for star in after.stars) <= 4.0
