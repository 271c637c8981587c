"""Files written and read by Orekit, in a process of its own, because it runs a Java machine, which starts once.

`orekit_files.py FOLDER` keeps a file for Orekit in the folder, and reads a list on each line of its input, as JSON:
`["write", FOLDER]`: AEMs of versions 1 and 2, as KVN and XML, of the rows in FOLDER/rows.json;
`["read", FILE]`: the matrices ICRS→body and rates of an AEM;
`["ephemeris", FILE, START, T …]`: position and velocity, m, m/s, by an STK ephemeris at seconds from a date.
It answers each with a line, a list of rows as JSON.
"""

import json
import sys
from pathlib import Path

import erfa
import jpype
import orekit_jpype

orekit_jpype.initVM()

from java.io import File, StringWriter
from java.util import ArrayList, HashMap
from org.hipparchus.geometry.euclidean.threed import Rotation, Vector3D
from org.orekit.data import DataContext, DataSource, DirectoryCrawler
from org.orekit.files.ccsds.definitions import FrameFacade, TimeSystem
from org.orekit.files.ccsds.ndm import ParserBuilder, WriterBuilder
from org.orekit.files.ccsds.ndm.adm import AdmHeader, AttitudeType
from org.orekit.files.ccsds.ndm.adm.aem import Aem, AemData, AemMetadata, AemSegment
from org.orekit.files.ccsds.utils.generation import KvnGenerator, XmlGenerator
from org.orekit.files.stk import STKEphemerisFile, STKEphemerisFileParser
from org.orekit.frames import FramesFactory
from org.orekit.time import AbsoluteDate, TimeScalesFactory
from org.orekit.utils import IERSConventions, TimeStampedAngularCoordinates

MONTHS = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")


def leap_seconds(folder: Path) -> None:
    lines = []
    for row in erfa.leap_seconds.get():
        year, month, offset = int(row["year"]), int(row["month"]), float(row["tai_utc"])
        jd = sum(erfa.cal2jd(year, month, 1))
        if year >= 1972:
            lines.append(
                f" {year} {MONTHS[month - 1]}  1 =JD {jd:9.1f}  TAI-UTC= {offset:5.1f}       S + (MJD - 41317.) X 0.0      S"
            )
    (folder / "tai-utc.dat").write_text("\n".join(lines) + "\n")
    DataContext.getDefault().getDataProvidersManager().addProvider(DirectoryCrawler(File(str(folder))))


def write(folder: Path) -> list[object]:
    rows = json.loads((folder / "rows.json").read_text())
    epoch = AbsoluteDate(rows["start"], TimeScalesFactory.getUTC())
    gcrf, j2000 = FramesFactory.getGCRF(), FramesFactory.getEME2000()
    bias = gcrf.getTransformTo(j2000, epoch).getRotation()
    dates = [epoch.shiftedBy(float(t)) for t in rows["t"]]
    data = AemData()
    for date, matrix, rate in zip(dates, rows["matrix"], rows["rate"], strict=True):
        turn = Rotation(jpype.JArray(jpype.JDouble, 2)(matrix), 1e-12)
        turn = turn.applyTo(bias.revert())  # the file refers to EME2000
        data.addData(TimeStampedAngularCoordinates(date, turn, Vector3D(rate), Vector3D.ZERO))
    body = FrameFacade.parse(
        "SC_BODY_1", IERSConventions.IERS_2010, True, DataContext.getDefault(), True, True, True
    )
    for version, kind in ((1.0, AttitudeType.QUATERNION), (2.0, AttitudeType.QUATERNION_ANGVEL)):
        for suffix in ("kvn", "xml"):
            header, meta = AdmHeader(), AemMetadata(2)
            header.setFormatVersion(version)
            header.setOriginator("OREKIT")
            header.setCreationDate(epoch)
            meta.setObjectName("TEST")
            meta.setObjectID("1998-999A")
            meta.setTimeSystem(TimeSystem.TAI)
            meta.setAttitudeType(kind)
            if version == 1.0:
                meta.setIsFirst(True)
            meta.getEndpoints().setFrameA(FrameFacade.map(j2000))
            meta.getEndpoints().setFrameB(body)
            meta.getEndpoints().setA2b(True)
            meta.setAngvelFrame(body)
            meta.setStartTime(dates[0])
            meta.setStopTime(dates[-1])
            segments = ArrayList()
            segments.add(AemSegment(meta, data))
            writer, text = WriterBuilder().buildAemWriter(), StringWriter()
            generator = (
                KvnGenerator(text, 20, "x", 0.0, 0)
                if suffix == "kvn"
                else XmlGenerator(text, 2, "x", 0.0, False, None)
            )
            aem = Aem(header, segments, IERSConventions.IERS_2010, DataContext.getDefault())
            writer.writeMessage(generator, aem)
            generator.close()
            (folder / f"v{version:.0f}.{suffix}").write_text(str(text))
    return []


def read(path: Path) -> list[object]:
    aem = ParserBuilder().buildAemParser().parseMessage(DataSource(str(path)))
    gcrf = FramesFactory.getGCRF()
    rows: list[object] = []
    for block in aem.getSegments():
        frame = block.getReferenceFrame()
        for each in block.getAngularCoordinates():
            turn = each.getRotation().applyTo(gcrf.getTransformTo(frame, each.getDate()).getRotation())
            matrix = [[float(value) for value in row] for row in turn.getMatrix()]
            rate = [float(value) for value in each.getRotationRate().toArray()]
            date = str(each.getDate().toString(TimeScalesFactory.getUTC()))
            rows.append({"date": date, "matrix": matrix, "rate": rate})
    return rows


def ephemeris(path: Path, start: str, *times: str) -> list[object]:
    """Of two segments that share a time, the later one holds."""
    utc, gcrf = TimeScalesFactory.getUTC(), FramesFactory.getGCRF()
    frames = HashMap()
    frames.put(STKEphemerisFile.STKCoordinateSystem.ICRF, gcrf)
    parser = STKEphemerisFileParser("x", 3.986004418e14, utc, frames)
    segments = list(parser.parse(DataSource(str(path))).getSatellites().get("x").getSegments())
    epoch = AbsoluteDate(start, utc)
    rows: list[object] = []
    for t in map(float, times):
        date = epoch.shiftedBy(t)
        segment = [each for each in segments if each.getStart().compareTo(date) <= 0][-1]
        state = segment.getPropagator().getPVCoordinates(date, gcrf)
        rows.append([float(x) for v in (state.getPosition(), state.getVelocity()) for x in v.toArray()])
    return rows


leap_seconds(Path(sys.argv[1]))
for line in sys.stdin:
    what, path, *others = json.loads(line)
    rows = {"write": write, "read": read, "ephemeris": ephemeris}[what](Path(path), *others)
    print(json.dumps(rows), flush=True)
