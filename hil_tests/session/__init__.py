"""Session scripts: reading, validation, execution and reports."""

from starhil.hil_tests.session.session_run import SessionRequest, run_session

__all__ = ["SessionRequest", "run_session"]
