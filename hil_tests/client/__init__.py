"""The OBC: sends telecommands, reads telemetry, downloads images."""

from starhil.hil_tests.client.async_client import AsyncObcClient
from starhil.hil_tests.client.client import ObcClient

__all__ = ["AsyncObcClient", "ObcClient"]
