"""Compression of stored images."""

from __future__ import annotations

from starhil.emulator.sensor.pipeline.messages import Failure, JpgRequest, JpgResult


def compress_image(request: JpgRequest) -> JpgResult | Failure:
    # Imported here because the process that serves the links needs neither, unless it has no worker.
    import cv2
    import numpy as np

    image = np.frombuffer(request.pixels, np.uint8).reshape(request.edge, request.edge)
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, request.quality])
    return JpgResult(data.tobytes()) if done else Failure("the image cannot be compressed")
