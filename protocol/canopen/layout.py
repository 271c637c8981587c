"""The layout of the interface definition in the object dictionary: `configs/icd/canopen.toml`."""

from __future__ import annotations

import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from starhil.protocol.icd import default_icd_path
from starhil.protocol.user_file import read_user_text
from starhil.protocol.values import IcdError

Index = Annotated[int, Field(ge=0x2000, le=0xFFFF)]
PackedType = Literal["u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "u48"]
FILE_NAME = "canopen.toml"


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class PackedField(_Model):
    """A field of a telemetry row as a narrower integer."""

    source: str = Field(alias="from")
    """ROW.FIELD; a bit selects the whole byte that contains it."""
    name: str | None = None
    """Name in the record; the field's name by default."""
    type: PackedType
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Physical = raw * scale."""
    wrap: bool = False
    """Keep the lowest bits of a counter instead of clipping it."""


class PlacedObject(_Model):
    """One object of the application and its content."""

    index: Index
    name: str
    requests: bool = False
    telemetry: str | None = None
    value: str | None = None
    telecommand: str | None = None
    parameters: bool = False
    image: Literal["frame", "stored"] | None = None
    packed: list[PackedField] = []

    @model_validator(mode="after")
    def _one_kind(self) -> PlacedObject:
        kinds = [
            bool(self.requests),
            self.telemetry is not None,
            self.value is not None or self.telecommand is not None,
            self.parameters,
            self.image is not None,
            bool(self.packed),
        ]
        if sum(kinds) != 1:
            raise ValueError(
                "needs exactly one of requests, telemetry, value and/or telecommand, parameters, image, packed"
            )
        return self


class PdoModel(_Model):
    """Default configuration of a PDO."""

    name: str
    enabled: bool = False
    transmission_type: Annotated[int, Field(ge=0, le=255)] = 255
    inhibit_ms: Annotated[float, Field(ge=0, le=6553.5)] = 0
    event_ms: Annotated[int, Field(ge=0, le=0xFFFF)] = 0
    objects: list[str] = []


class CanopenModel(_Model):
    """Content of the table `canopen`."""

    device_type: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    device_name: str
    vendor_name: str
    vendor_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    product_code: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    revision: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    bit_rates: list[int] = Field(min_length=1)
    object: list[PlacedObject] = Field(min_length=1)
    tpdo: list[PdoModel] = []
    rpdo: list[PdoModel] = []


class _FileModel(_Model):
    canopen: CanopenModel


def load_layout(path: Path | str | None = None) -> CanopenModel:
    """Read the layout of the interface definition in the object dictionary.

    Parameters
    ----------
    path
        The file or its folder; by default the file that ships with the package, read once.

    Raises
    ------
    IcdError
        The text names file and key.
    """
    if path is None:
        return _load_default()
    path = Path(path)
    return _load(path / FILE_NAME if path.is_dir() else path)


@lru_cache(maxsize=1)
def _load_default() -> CanopenModel:
    return _load(default_icd_path() / FILE_NAME)


def _load(path: Path) -> CanopenModel:
    try:
        document = tomllib.loads(read_user_text(path))
        return _FileModel.model_validate(document).canopen
    except OSError as error:
        raise IcdError(f"{path}: cannot read the CANopen layout: {error.strerror}") from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(step) for step in first["loc"])
        raise IcdError(f"{path}: {key}: {first['msg']}") from None
    except (ValueError, RecursionError) as error:
        raise IcdError(f"{path}: not valid TOML: {error}") from None
