"""The allowed images of a lab; only their pixels are shown."""

import base64
import io
from pathlib import Path

import pytest
from PIL import Image

from xplain.errors import InputError
from xplain.people.material import read_own_table

FACTS = "fact,message,belief\ncable,Cables are fine.,Cables stop it.\n"


def table(folder: Path, image: str) -> Path:
    """Makes a table with one image, and its facts."""
    (folder / "facts.csv").write_text(FACTS)
    (folder / "own.csv").write_text(
        f"text,image,alt,inexplicable_if,floor\nDrives over it,{image},A cable,cable,0\n"
        "Goes around it,,,,1\n"
    )
    return folder / "own.csv"


def shown(folder: Path, image: str) -> Image.Image:
    """Returns the picture that participants get."""
    source = read_own_table(table(folder, image), str(folder / "facts.csv"), 0)
    picture = source.clips[0].picture
    assert picture is not None
    return Image.open(io.BytesIO(base64.b64decode(picture.content)))


def test_pixels_are_kept_and_where_they_were_taken_is_not(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x010E] = "taken at home"
    exif[0x8825] = {1: "N", 2: (52.0, 30.0, 0.0)}
    Image.new("RGB", (40, 30), "red").save(tmp_path / "a.jpg", exif=exif, comment=b"by Ann")
    assert b"taken at home" in (tmp_path / "a.jpg").read_bytes()
    picture = shown(tmp_path, "a.jpg")
    assert (picture.size, picture.format) == ((40, 30), "JPEG")
    assert not picture.getexif()
    assert "comment" not in picture.info
    assert picture.getpixel((20, 15))[0] > 250  # type: ignore[index]


@pytest.mark.parametrize("name", ["page.png", "empty.png", "wide.png", "link.png", "../up.png"])
def test_what_is_no_picture_of_the_folder_is_refused(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "lab"
    folder.mkdir()
    (folder / "page.png").write_text("<html><script>alert(1)</script></html>")
    (folder / "empty.png").write_bytes(b"")
    Image.new("1", (60_000, 10)).save(folder / "wide.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "up.png")
    (folder / "link.png").symlink_to(tmp_path / "up.png")
    with pytest.raises(InputError, match=r"transitions\.image"):
        shown(folder, name)


def test_a_picture_of_too_many_pixels_is_refused_before_they_are_read(tmp_path: Path) -> None:
    """Only the header says 60,000 × 60,000; decoding would take 10 GB."""
    picture = io.BytesIO()
    Image.new("1", (8, 8)).save(picture, "PNG")
    data = bytearray(picture.getvalue())
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    import zlib

    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    (tmp_path / "bomb.png").write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"transitions\.image"):
        shown(tmp_path, "bomb.png")
