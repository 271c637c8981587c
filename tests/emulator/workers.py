"""Programs that stand in for the pipeline worker: they render no images, and fail where a test wants them to."""

from tests.emulator.runs import CAMERA

WORKER = """
import pickle, socket, sys
from starhil.emulator.sensor.pipeline.messages import LENGTH, Failure, FrameResult, PipelineReady
link = socket.socket(fileno=int(sys.argv[1]))
stream = link.makefile("rwb")
def receive():
    head = stream.read(LENGTH.size)
    return pickle.loads(stream.read(LENGTH.unpack(head)[0])) if head else None
def send(message):
    data = pickle.dumps(message)
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()
setup = receive()
"""
"""The beginning of a worker that renders no images: what it does then is the test's."""

ANSWERING = (
    WORKER
    + f"send(PipelineReady({CAMERA}, 5, 0.0))\nn = 0\nwhile receive():\n n += 1\n send(FrameResult(n))\n"
)
