"""The outcome of requests when an answer's callback fails, or when the pipeline ends in the middle."""

import asyncio
import gc
import pickle

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.pipeline.client import WorkerClient
from starhil.emulator.sensor.pipeline.messages import (
    Failure,
    FrameResult,
    ImageRequest,
    PipelineEnded,
    PipelineReady,
    with_length,
)
from starhil.emulator.sensor.pipeline.worker_process import WorkerThread
from tests.emulator.runs import CAMERA
from tests.emulator.workers import ANSWERING, WORKER
from tests.waiting import PATIENCE_S, turns, until

SETUP = pipeline_setup(Profile())
REQUEST = ImageRequest(64)


class FakePipeline:
    """Answers with numbered frames; `ImageRequest(0)` ends the thread."""

    def __init__(self):
        self.count = 0

    def handle(self, request):
        if request.edge == 0:
            raise SystemExit
        self.count += 1
        return FrameResult(self.count)


@pytest.fixture(params=["process", "thread"])
def make_pipeline(request, worker, monkeypatch):
    """Make an imager that answers with numbered frames and can be killed."""
    monkeypatch.setattr(
        "starhil.emulator.sensor.pipeline.pipeline.make_pipeline",
        lambda _setup, _helper: (FakePipeline(), PipelineReady({}, 5, 0.0)),
    )

    def make():
        if request.param == "process":
            imager = WorkerClient(SETUP, worker(ANSWERING))
            imager.kill = lambda: imager.worker.process.kill()
        else:
            imager = WorkerClient(SETUP, WorkerThread())
            imager.kill = lambda: imager._writer.write(with_length(ImageRequest(0)))
        return imager

    return make


def run(imager_of, scenario):
    async def whole():
        imager = imager_of()
        try:
            await asyncio.wait_for(imager.start(), PATIENCE_S)
            await asyncio.wait_for(scenario(imager), PATIENCE_S)
        finally:
            await imager.close()

    asyncio.run(whole())


def test_a_callback_that_fails_is_logged_and_the_next_requests_are_answered(make_pipeline, caplog):
    answers = []

    async def scenario(imager):
        imager.submit(REQUEST, lambda answer: answer.no_such_field)
        imager.submit(REQUEST, answers.append)
        await imager.settle()
        imager.submit(REQUEST, answers.append)
        await imager.settle()
        assert imager.pending == 0

    run(make_pipeline, scenario)
    assert [answer.index for answer in answers] == [2, 3]
    (said,) = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert "no_such_field" in said
    assert "\n" not in said


def test_a_pipeline_that_ends_fails_pending_requests_and_can_be_restarted(make_pipeline, caplog):
    answers, losses = [], []

    async def scenario(imager):
        imager.ended.connect(losses.append)
        imager.kill()
        imager.submit(REQUEST, answers.append)
        await imager.settle()
        await until(lambda: losses)
        imager.submit(REQUEST, answers.append)
        assert [type(answer) for answer in answers] == [PipelineEnded, PipelineEnded]
        await imager.restart()
        imager.submit(REQUEST, answers.append)
        await imager.settle()
        assert isinstance(answers[-1], FrameResult)

    run(make_pipeline, scenario)
    (said,) = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert [said] == losses


def test_requests_fail_in_their_order_before_the_death_of_the_worker_is_noticed(worker):
    answers = []

    async def scenario(imager):
        imager.submit(REQUEST, lambda answer: answers.append(("first", type(answer))))
        imager.worker.process.kill()
        imager.worker.process.wait()
        imager.submit(REQUEST, lambda answer: answers.append(("second", type(answer))))
        await imager.settle()

    silent = f"{WORKER}send(PipelineReady({CAMERA}, 5, 0.0))\nreceive()\nreceive()\n"
    run(lambda: WorkerClient(SETUP, worker(silent)), scenario)
    assert answers == [("first", PipelineEnded), ("second", PipelineEnded)]


def test_a_failure_handler_that_fails_keeps_no_request_pending(make_pipeline, caplog):
    async def scenario(imager):
        imager.ended.connect(lambda _text: 1 / 0)
        imager.kill()
        imager.submit(REQUEST, lambda _answer: None)
        await imager.settle()
        await until(lambda: "ZeroDivisionError" in caplog.text)

    run(make_pipeline, scenario)


@pytest.mark.parametrize("bad", ["b'no pickle'", "pickle.dumps(PipelineReady)", "pickle.dumps(None) + b'x'"])
def test_an_answer_that_cannot_be_read_loses_the_worker_and_is_logged(worker, caplog, bad):
    program = WORKER + (
        "send(PipelineReady({}, 5, 0.0))\n"
        f"data = {bad}\nreceive()\nstream.write(LENGTH.pack(len(data)) + data)\n"
        "send(FrameResult(1)); send(FrameResult(2))\nstream.flush()\nreceive()\n"
    )
    answers, losses = [], []

    async def scenario(imager):
        imager.ended.connect(losses.append)
        imager.submit(REQUEST, answers.append)
        await until(lambda: losses)
        await imager.settle()
        imager.submit(REQUEST, answers.append)
        assert isinstance(answers[-1], Failure)

    run(lambda: WorkerClient(SETUP, worker(program)), scenario)
    assert "cannot be read" in losses[0]
    assert "\n" not in losses[0]


@pytest.mark.parametrize(
    "program",
    [
        "",
        WORKER + "send(Failure('no catalogue'))\n",
        WORKER + "stream.write(LENGTH.pack(3) + b'abc')\nstream.flush()\nreceive()\n",
    ],
)
def test_a_start_that_fails_raises_once_and_is_no_loss(worker, program):
    losses = []

    async def scenario():
        imager = WorkerClient(SETUP, worker(program))
        imager.ended.connect(losses.append)
        try:
            with pytest.raises(EmulatorError, match=r"no catalogue|pipeline worker"):
                await asyncio.wait_for(imager.start(), PATIENCE_S)
            await turns()
        finally:
            await imager.close()

    asyncio.run(scenario())
    assert losses == []


def test_a_request_that_cannot_be_sent_is_not_left_pending(worker):
    async def scenario(imager):
        with pytest.raises((pickle.PicklingError, AttributeError)):
            imager.submit(lambda: None, lambda _answer: None)
        assert imager.pending == 0

    run(lambda: WorkerClient(SETUP, worker(ANSWERING)), scenario)


def test_a_thread_whose_pipeline_cannot_be_made_reports_it(monkeypatch):
    def fail(_setup, _helper):
        raise ValueError("odd\ncamera")

    monkeypatch.setattr("starhil.emulator.sensor.pipeline.pipeline.make_pipeline", fail)

    async def scenario():
        imager = WorkerClient(SETUP, WorkerThread())
        try:
            with pytest.raises(EmulatorError, match="ValueError: odd camera"):
                await asyncio.wait_for(imager.start(), PATIENCE_S)
            await until(gc.isenabled)
        finally:
            await imager.close()

    asyncio.run(scenario())
