"""The image pipeline of a profile."""

from __future__ import annotations

from typing import TypeAlias

from starhil.emulator.profile.profile import Profile
from starhil.emulator.sensor.pipeline.client import WorkerClient
from starhil.emulator.sensor.pipeline.error_model import ErrorModel
from starhil.emulator.sensor.pipeline.messages import PipelineSetup, SolverSettings, SolvingOptions
from starhil.emulator.sensor.pipeline.worker_process import WorkerProcess, WorkerThread
from starhil.protocol.icd.device_model import device_model

SensorPipeline: TypeAlias = WorkerClient | ErrorModel
"""An image pipeline that can be started, and started again after an unexpected end."""


def make_pipeline(
    profile: Profile, worker: WorkerProcess | None, *, repeatable: bool, previews: bool
) -> SensorPipeline:
    """Return the pipeline of a profile; a worker that was started earlier is used, or ended."""
    setup = pipeline_setup(profile, repeatable=repeatable, previews=previews)
    if profile.run.worker == "process":
        return WorkerClient(setup, worker or WorkerProcess())
    if worker is not None:
        worker.end(grace_s=0.0)  # it still imports what nobody needs
    if profile.run.worker == "error_model":
        return ErrorModel(setup)
    return WorkerClient(setup, WorkerThread())


def pipeline_setup(profile: Profile, *, repeatable: bool = False, previews: bool = False) -> PipelineSetup:
    """Return the pipeline configuration of a profile; `repeatable`: results independent of machine speed."""
    path = profile.catalog.path
    return PipelineSetup(
        camera=profile.camera_values,
        sensor=dict(profile.sensor),
        sky=dict(profile.sky),
        identifier=dict(profile.identifier),
        catalog_path=str(profile.folder / path) if path else "",
        epoch=profile.epoch,
        algorithm=profile.run.algorithm,
        settings=SolverSettings.of({name: item.default for name, item in device_model().parameters.items()}),
        seed=profile.run.seed,
        build_in_background=profile.run.clock != "stepped" and not repeatable,
        previews=previews,
        device=SolvingOptions.of(dict(profile.device)),
        calibration=profile.calibration.matrix(),
        exposure_s=float(profile.parameters.get("exposure", 200)) / 1000.0,
        images=profile.images.resolved(profile.folder),
    )
