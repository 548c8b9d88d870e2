"""GPS of photographs' headers and of files beside a stream: places, times, names, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.gps import read_gps
from tests.support.dataset_folders import write_photos
from tests.support.shared_data import shared

DJI = """1
00:00:00,000 --> 00:00:00,033
<font size="28">FrameCnt: 1, DiffTime: 33ms
[iso: 100] [shutter: 1/800] [latitude: 47.100000] [longtitude: 8.200000] [rel_alt: 10.0 abs_alt: 510.0] </font>

2
00:00:01,000 --> 00:00:01,033
[latitude: 47.100020] [longitude: 8.200040] [altitude: 512.0]

3
00:00:02,000 --> 00:00:02,033
GPS(8.200080,47.100040,17) BAROMETER:24.0

4
00:00:03,000 --> 00:00:03,033
[latitude: 0.0] [longitude: 0.0] [rel_alt: 0.0 abs_alt: 0.0]
"""


def write_exif(path: Path, tags: dict[int, object]) -> None:
    with Image.open(path) as image:
        exif = image.getexif()
        exif.get_ifd(0x8825).update(tags)
        image.save(path, exif=exif)


def photographs(folder: Path, count: int) -> Path:
    folder.mkdir()
    for n in range(count):
        Image.new("RGB", (64, 48), (n, 0, 0)).save(folder / f"IMG_{n}.jpg")
    return folder


def places(folder: Path, **options: object) -> list[np.ndarray | None]:
    return [item.place for item in open_dataset("images", path=folder, **options)]


def test_exif_has_degrees_minutes_seconds_and_the_altitudes_reference(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "photos", 5)
    south = {1: "S", 2: (33.0, 52.0, 10.5), 3: "W", 4: (70.0, 30.0, 0.0), 5: b"\x01", 6: 12.25}
    write_exif(folder / "IMG_0.jpg", south)
    write_exif(folder / "IMG_1.jpg", {1: "N", 2: (33.5, 0.0, 0.0), 3: "E", 4: (151.0, 12.6, 0.0), 5: b"\x00", 6: 58.0})
    write_exif(folder / "IMG_2.jpg", {1: "N", 2: (33.0, 0.0, 0.0), 3: "E", 4: (151.0, 0.0, 0.0)})
    write_exif(folder / "IMG_3.jpg", south | {2: (133.0, 0.0, 0.0)})
    sequence = open_dataset("images", path=folder, intrinsics="auto")
    found = [item.place for item in sequence]
    np.testing.assert_allclose(found[0], [-(33 + 52 / 60 + 10.5 / 3600), -70.5, -12.25])
    np.testing.assert_allclose(found[1], [33.5, 151.21, 58.0])
    assert found[2:] == [None, None, None]  # no altitude, no such latitude, no header
    assert "photographs whose GPS has no altitude, and is not used: 1 (first: IMG_2.jpg)" in sequence.warnings


def test_photographs_of_a_drone() -> None:
    found = places(shared("data/aerial_caliterra"), stop=2)
    assert found[0] is not None
    np.testing.assert_allclose(
        found[0], [30 + 10 / 60 + 16.404 / 3600, -(98 + 5 / 60 + 23.97 / 3600), 317.3], atol=1e-9
    )


def test_a_file_names_frames(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "photos", 3)
    table = tmp_path / "gps.csv"
    table.write_text("Filename; Lat; Lon; Alt; Time\nphotos/img_2.JPG;47.5;8.5;400;x\nIMG_0;47.4;8.4;401;x\n")
    first, second, third = places(folder, gps=table)
    np.testing.assert_allclose(first, [47.4, 8.4, 401.0])
    assert second is None
    np.testing.assert_allclose(third, [47.5, 8.5, 400.0])


def test_equal_names_in_several_folders_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    for camera in ("100MEDIA", "101MEDIA"):
        photographs(tmp_path / camera, 2)
    table = tmp_path / "gps.csv"
    lines = [f"D:\\flight\\{camera}\\IMG_{n}.JPG,{40 + k},8,{n}\n" for k, camera in enumerate(("100MEDIA", "101media"))
             for n in range(2)]  # fmt: skip
    table.write_text("SourceFile,lat,lon,alt\n" + "".join(lines))
    found = np.array(places(tmp_path, gps=table))
    np.testing.assert_allclose(found[:, [0, 2]], [[40, 0], [40, 1], [41, 0], [41, 1]])
    table.write_text("SourceFile,lat,lon,alt\nIMG_0.jpg,40,8,1\n100MEDIA/IMG_1.jpg,41,8,2\n")
    sequence = open_dataset("images", path=tmp_path, gps=table)
    found = [item.place for item in sequence]
    assert [place is not None for place in found] == [False, True, False, False], "IMG_0 may be either"
    told = (
        f"images without a place, as several have the name in {table}, which should have their folders too: 2 (first:"
    )
    assert any(w.startswith(told) for w in sequence.warnings)
    table.write_text("SourceFile,lat,lon,alt\nIMG_0.jpg,40,8,1\n101MEDIA/IMG_0.jpg,41,8,2\n")
    found = places(tmp_path, gps=table)
    assert [None if place is None else place[0] for place in found] == [40, None, 41, None], "each the one that suits"
    table.write_text("SourceFile,lat,lon,alt\nIMG_0.jpg,40,8,1\nIMG_0.jpg,41,8,2\n")
    assert places(tmp_path / "100MEDIA", gps=table) == [None, None], "it has two places"


def test_times_are_interpolated_once_a_fix_and_not_over_gaps(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 9)
    (tmp_path / "dji.SRT").write_text(DJI)
    found = places(tmp_path / "photos", gps=tmp_path / "dji.SRT", rate=4.0)  # 0 to 2 s; the first second has one fix
    assert [n for n, place in enumerate(found) if place is not None] == [0, 4, 8]
    np.testing.assert_allclose(found[0], [47.1, 8.2, 510.0])
    np.testing.assert_allclose(found[8], [47.10004, 8.20008, 24.0])
    sparse = places(tmp_path / "photos", gps=tmp_path / "dji.SRT", rate=4.0, start=2, stride=4)
    np.testing.assert_allclose(sparse[0], [47.10001, 8.20002, 511.0])
    (tmp_path / "gap.csv").write_text("t,lat,lon,alt\n0,47,8,1\n60,47.1,8.1,2\n")
    assert places(tmp_path / "photos", gps=tmp_path / "gap.csv", rate=4.0)[1] is None


def test_a_clocks_times_need_the_streams_beginning(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 3)
    gpx = tmp_path / "track.gpx"
    points = "".join(
        f'<trkpt lat="{47 + n}" lon="{179.5 + n if n == 0 else -179.5}"><ele>{n}</ele>'
        f"<time>2026-05-01T12:00:0{n}Z</time></trkpt>"
        for n in range(2)
    )
    gpx.write_text(f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>')
    with pytest.raises(ValueError, match=r"set dataset.gps_start=2026-01-31T12:00:00Z"):
        places(tmp_path / "photos", gps=gpx)
    found = places(tmp_path / "photos", gps=gpx, rate=2.0, gps_start="2026-05-01T14:00:00.5+02:00")
    np.testing.assert_allclose(found[0], [47.5, 180.0, 0.5])  # over the 180th meridian
    sequence = open_dataset("images", path=tmp_path / "photos", gps=gpx, gps_start="2026-05-01T18:00:00Z")
    assert [item.place for item in sequence] == [None, None, None]
    assert (
        f"{gpx} has a place for 0 of 3 frames: its times are 2026-05-01T12:00:00Z to 2026-05-01T12:00:01Z, the frames' "
        "2026-05-01T18:00:00Z to 2026-05-01T18:00:00Z; is it another time zone? dataset.gps_start says when the first "
        "frame was, with its zone"
    ) in sequence.warnings
    with pytest.raises(BadFileError, match=r"dataset.gps_start has no time of ISO 8601"):
        places(tmp_path / "photos", gps=gpx, gps_start="yesterday")


@pytest.mark.parametrize(
    ("table", "doubt"),
    [
        (
            "time,lat,lon,alt\n" + "".join(f"{33000 * n},47.{n},8,0\n" for n in range(3)),  # of milliseconds
            "a place for 1 of 8 frames: its times are 0 s to 66000 s, the frames' 0 s to 7 s; between two that are "
            "33000 s apart, over 5 s, nothing is interpolated: are they milliseconds? Write them in seconds",
        ),
        (
            "time,lat,lon,alt\n" + "".join(f"{100 + n},47.{n},8,0\n" for n in range(9)),
            "a place for 0 of 8 frames: its times are 100 s to 108 s, the frames' 0 s to 7 s; is it another unit, or "
            "beginning? Write them in seconds from the first frame",
        ),
        (
            "time,lat,lon,alt\n" + "".join(f"{5 + n},47.{n},8,0\n" for n in range(9)),
            "a place for 3 of 8 frames: its times are 5 s to 13 s, the frames' 0 s to 7 s; is it another unit, or "
            "beginning? Write them in seconds from the first frame",
        ),
        ("time,lat,lon,alt\n" + "".join(f"{n},47.{n},8,0\n" for n in range(9)), None),
        ("time,lat,lon,alt\n" + "".join(f"{n},47,8,0\n" for n in range(9)), None),  # a receiver that stands still
    ],
)
def test_times_that_place_few_frames_are_said_beside_the_frames(table: str, doubt: str | None, tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 8)
    (tmp_path / "gps.csv").write_text(table)
    sequence = open_dataset("images", path=tmp_path / "photos", gps=tmp_path / "gps.csv", rate=1.0, intrinsics="auto")
    for _ in range(2):
        list(sequence)
        said = [warning for warning in sequence.warnings if str(tmp_path / "gps.csv") in warning]
        assert said == ([] if doubt is None else [f"{tmp_path / 'gps.csv'} has {doubt}"])


def test_names_that_are_of_no_frame_are_said(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 2)
    (tmp_path / "gps.csv").write_text("frame,lat,lon,alt\n0,47,8,0\n1,47.1,8,0\n")
    sequence = open_dataset("images", path=tmp_path / "photos", gps=tmp_path / "gps.csv")
    list(sequence)
    assert any("no frame has a place in" in w and "it names '0'; give it the names" in w for w in sequence.warnings)


@pytest.mark.parametrize(
    "mark", ["<ele>400</ele><name>Home</name>", "<name>Home</name>", "<ele>400</ele>", "<ele>400</ele><time>x</time>"]
)
def test_marks_beside_a_track_are_none_of_its_places(mark: str, tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 2)
    points = "".join(
        f'<trkpt lat="47.{n}" lon="8"><ele>{n}</ele><time>2026-05-01T12:00:0{n}Z</time></trkpt>' for n in range(2)
    )
    (tmp_path / "a.gpx").write_text(f'<gpx><wpt lat="47" lon="8">{mark}</wpt><trk>{points}</trk></gpx>')
    assert read_gps(tmp_path / "a.gpx").warnings == []
    found = places(tmp_path / "photos", gps=tmp_path / "a.gpx", rate=1.0, gps_start="2026-05-01T12:00:00Z")
    np.testing.assert_allclose(np.array(found), [[47.0, 8.0, 0.0], [47.1, 8.0, 1.0]])


def test_a_frame_that_is_not_named_is_placed_by_its_time(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 2)
    named = '<wpt lat="46" lon="7"><ele>1</ele><name>photo0.png</name></wpt>'
    timed = "".join(
        f'<wpt lat="47.{n}" lon="8"><ele>{n}</ele><time>2026-05-01T12:00:0{n}Z</time></wpt>' for n in range(2)
    )
    (tmp_path / "a.gpx").write_text(f"<gpx>{named}{timed}</gpx>")
    found = places(tmp_path / "photos", gps=tmp_path / "a.gpx", rate=1.0, gps_start="2026-05-01T12:00:00Z")
    np.testing.assert_allclose(np.array(found), [[46.0, 7.0, 1.0], [47.1, 8.0, 1.0]])


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("a.csv", "time,lat,lon\n0,1,2\n", "its header has no altitude"),
        ("b.csv", "lat,lon,alt\n1,2,3\n", "its header has no time or frame name"),
        ("c.csv", "t,lat,lon,alt\n0,91,2,3\n", "line 2: latitude 91, longitude 2, altitude 3 are no place"),
        ("d.csv", "t,lat,lon,alt\n0,x,2,3\n", "line 2, '0,x,2,3'"),
        ("e.csv", "t,lat,lon,alt\n0,nan,2,3\n", "line 2: latitude nan"),
        ("f.csv", "t,lat,lon,alt\n1767225600000,1,2,3\n", "its times are neither"),
        ("g.csv", "t,lat,lon,alt\n0,0,0,0\n", "it has no place, of 1 entries"),
        ("h.gpx", "<gpx><wpt", "is no file of GPS places"),
        ("i.gpx", '<!DOCTYPE x [<!ENTITY a "b">]><gpx/>', "it defines entities"),
        ("j.srt", "nothing", "it has no place, of 0 entries"),
        ("k.kml", "", "GPS is read from .csv, .tsv, .txt, .gpx, .srt"),
        ("l.csv", "", "its header has no latitude"),
    ],
)  # fmt: skip
def test_what_is_refused(tmp_path: Path, name: str, text: str, why: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(BadFileError) as error:
        read_gps(tmp_path / name)
    assert str(tmp_path / name) in str(error.value)
    assert why in str(error.value)


@pytest.mark.parametrize("time", ["nan", "inf", "-inf"])
def test_a_place_at_no_time_is_refused(time: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"time,lat,lon,alt\n0,47,8,1\n{time},47,8,1\n2,47,8,1\n")
    with pytest.raises(BadFileError, match=rf"a\.csv .*line 3, .*: {time} is no time"):
        read_gps(tmp_path / "a.csv")


def test_a_point_of_gpx_with_an_empty_time_goes_by_its_name(tmp_path: Path) -> None:
    points = '<wpt lat="47" lon="8"><ele>1</ele><time/><name>IMG_0.jpg</name></wpt>'
    points += '<wpt lat="48" lon="8"><ele>1</ele><time>2026-05-01T12:00:00Z</time><name>IMG_1.jpg</name></wpt>'
    (tmp_path / "a.gpx").write_text(f"<gpx>{points}</gpx>")
    track = read_gps(tmp_path / "a.gpx")
    assert [name for name, _ in track.named] == ["img_0.jpg"]
    assert len(track.seconds) == 1
