"""A photograph keeps what it holds: depth, grey, CMYK, alpha, profile, EXIF, resolution, and what was not relit."""

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms, ImageOps, features

from facerelight.photo.files.disk import check_writable, find_photos, not_held, read_photo, write_photo
from facerelight.photo.files.exif import turn_upright
from facerelight.photo.files.photograph import PhotoFile, from_pillow, to_pillow
from facerelight.photo.files.profiles import SRGB, PlainCmyk, TableProfile, read_profile
from facerelight.photo.files.sixteen_bits import write_png, write_tiff

P3 = ((0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407))  # XYZ, D50
NOISE = np.random.default_rng(0)


def icc(curves: list[bytes], primaries: tuple[tuple[float, ...], ...] = P3, space: bytes = b"RGB ") -> bytes:
    """A display profile of a matrix and curves, version 2."""

    def xyz(values: tuple[float, ...]) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(v * 65536) for v in values))

    white = (0.96420, 1.0, 0.82491)
    name = b"desc\0\0\0\0" + struct.pack(">I", 5) + b"test\0" + bytes(78)
    tags = {b"desc": name, b"wtpt": xyz(white), b"cprt": b"text\0\0\0\0none\0"}
    if space == b"GRAY":
        tags[b"kTRC"] = curves[0]
    else:
        for letter, primary, curve in zip((b"r", b"g", b"b"), primaries, curves, strict=True):
            tags[letter + b"XYZ"], tags[letter + b"TRC"] = xyz(primary), curve
    return assembled(tags, b"mntr", space, b"XYZ ")


def assembled(tags: dict[bytes, bytes], kind: bytes, space: bytes, connection: bytes) -> bytes:
    """The profile of ``tags``."""
    offset, table, body = 132 + 12 * len(tags), b"", b""
    for tag, data in tags.items():
        table += struct.pack(">4sII", tag, offset + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(">I4sI4s4s4s", offset + len(body), b"lcms", 0x02400000, kind, space, connection)
    head += bytes(12) + b"acsp" + bytes(28)
    head += struct.pack(">3i", 63190, 65536, 54061) + bytes(48)
    return head + struct.pack(">I", len(tags)) + table + body


def gamma(value: float) -> bytes:
    return b"curv\0\0\0\0" + struct.pack(">IH", 1, round(value * 256)) + bytes(2)


def parametric(*values: float) -> bytes:
    kind = {1: 0, 3: 1, 4: 2, 5: 3, 7: 4}[len(values)]
    return b"para\0\0\0\0" + struct.pack(f">HH{len(values)}i", kind, 0, *(round(v * 65536) for v in values))


SRGB_PARAMETERS = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
WIDE = icc([parametric(*SRGB_PARAMETERS)] * 3)
ADOBE_PRIMARIES = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
ADOBE = icc([gamma(2.19921875)] * 3, ADOBE_PRIMARIES)
GREY = icc([gamma(1.8)], space=b"GRAY")


def picture(size: tuple[int, int] = (20, 30)) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (*size, 3)).astype(np.uint8)


def relit(pixels: np.ndarray) -> np.ndarray:
    """The middle made half as bright in code values."""
    out = pixels.copy()
    out[5:15, 5:15] //= 2
    return out


def outside(values: np.ndarray) -> np.ndarray:
    mask = np.ones(values.shape[:2], bool)
    mask[5:15, 5:15] = False
    return values[mask]


@pytest.mark.parametrize("profile", [WIDE, ADOBE], ids=["p3", "adobe"])
def test_profile_decoded_as_lcms_does(profile: bytes) -> None:
    exact, table = read_profile(profile, 3), TableProfile(profile)
    values = (0.2 + 0.5 * NOISE.random((3000, 1))) * (0.85 + 0.3 * NOISE.random((3000, 3)))  # inside sRGB
    codes = np.rint(values * 255).astype(np.uint8)
    linear = exact.decode(codes / 255)
    assert type(exact).__name__ == "MatrixProfile"
    coded = SRGB.encode(linear) * 255
    assert np.abs(coded - table.to_srgb(codes[None])[0]).max() < 1.5
    assert np.abs(exact.encode(linear) - codes / 255).max() < 1e-4
    assert np.abs(table.encode(linear) - codes / 255).max() < 2.5 / 255


def test_parametric_curves_as_lcms_reads_them() -> None:
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, 1)
    full = (2.4, 0.9, 0.05, 0.08, 0.05, 0.01, 0.002)
    for curve in ((1.8,), (2.0, 1.1, -0.1), (2.2, 0.9, 0.05, 0.02), SRGB_PARAMETERS, full):
        profile = icc([parametric(*curve)] * 3)
        exact = SRGB.encode(read_profile(profile, 3).decode(ramp / 255)) * 255
        assert np.abs(exact - TableProfile(profile).to_srgb(ramp[None])[0]).max() < 2, curve


def test_srgb_itself_and_broken_profiles() -> None:
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    assert read_profile(own, 3) is SRGB
    assert read_profile(own, 1) is None
    for broken in (b"", b"profile", own[:100], own[:200], own[:40] + bytes(400)):
        assert read_profile(broken, 3) is None
    image = Image.fromarray(picture())
    image.info["icc_profile"] = own[:200]
    assert from_pillow(image).icc is None


@pytest.mark.parametrize(("name", "profile"), [("p3.png", WIDE), ("adobe.tif", ADOBE), ("wide.png", WIDE)])
def test_profile_kept_and_untouched_pixels_to_the_bit(name: str, profile: bytes, tmp_path: Path) -> None:
    stored = picture()
    Image.fromarray(stored).save(tmp_path / name, icc_profile=profile)
    photo = read_photo(tmp_path / name)
    assert np.abs(photo.pixels.astype(int) - stored).max() > 20
    write_photo(tmp_path / f"out_{name}", relit(photo.pixels), photo)
    with Image.open(tmp_path / f"out_{name}") as image:
        assert image.info["icc_profile"] == profile
        written = np.asarray(image)
    assert np.array_equal(outside(written), outside(stored))
    seen = read_photo(tmp_path / f"out_{name}").pixels
    assert np.abs(seen.astype(int) - relit(photo.pixels)).mean() < 2


def test_wide_colours_stay_wide_where_relit() -> None:
    """A red that sRGB has no number for, made darker: still outside sRGB, of the same hue."""
    photo = PhotoFile(np.full((8, 8, 3), (250, 20, 30), np.uint8), icc=WIDE)
    darker = np.rint(photo.pixels * 0.7).astype(np.uint8)
    before, after = (photo.profile.decode(v.reshape(-1, 3)[:1] / 255)[0] for v in (photo.stored, photo.relit(darker)))
    assert before[1] < -0.02
    assert after[1] < -0.01
    assert np.allclose(after / np.abs(after).max(), before / np.abs(before).max(), atol=0.01)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA"])
def test_sixteen_bits(suffix: str, mode: str, tmp_path: Path) -> None:
    channels = len(mode)
    values = NOISE.integers(0, 65536, (20, 30, channels)).astype(np.uint16)
    if mode == "LA" and suffix == ".tif":
        pytest.skip("Pillow reads no such file")
    path = tmp_path / f"in{suffix}"
    exif = Image.Exif()
    exif[0x010F] = "camera"
    with path.open("wb") as file:
        (write_png if suffix == ".png" else write_tiff)(file, values, None, exif.tobytes(), (300, 300))
    photo = read_photo(path)
    assert photo.mode == mode
    assert photo.bits == 16
    assert photo.pixels.dtype == np.uint16
    write_photo(tmp_path / f"out{suffix}", relit(photo.pixels), photo)
    again = read_photo(tmp_path / f"out{suffix}")
    assert np.array_equal(outside(again.stored), outside(photo.stored))
    assert np.abs(again.pixels.astype(int) - relit(photo.pixels)).max() <= (0 if "RGB" in mode else 40000)
    if photo.stored_alpha is not None:
        assert np.array_equal(again.stored_alpha, values[..., -1])
    seen = cv2.imread(str(tmp_path / f"out{suffix}"), cv2.IMREAD_UNCHANGED)
    assert seen.dtype == np.uint16
    with Image.open(tmp_path / f"out{suffix}") as image:
        assert round(image.info["dpi"][0]) == 300
        assert image.getexif()[0x010F] == "camera"


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_in_a_wide_space(suffix: str, tmp_path: Path) -> None:
    values = NOISE.integers(0, 65536, (20, 30, 3)).astype(np.uint16)
    path, out = tmp_path / f"in{suffix}", tmp_path / f"out{suffix}"
    with path.open("wb") as file:
        (write_png if suffix == ".png" else write_tiff)(file, values, WIDE, None, None)
    photo = read_photo(path)
    assert photo.icc == WIDE
    write_photo(out, relit(photo.pixels), photo)
    again = read_photo(out)
    assert again.icc == WIDE
    assert np.array_equal(outside(again.stored), outside(values))
    assert np.median(np.abs(again.pixels.astype(int) - relit(photo.pixels))) < 3


def test_sixteen_bits_turned(tmp_path: Path) -> None:
    values = NOISE.integers(0, 65536, (20, 30, 3)).astype(np.uint16)
    exif = Image.Exif()
    exif[0x0112] = 6
    with (tmp_path / "in.png").open("wb") as file:
        write_png(file, values, None, exif.tobytes(), None)
    photo = read_photo(tmp_path / "in.png")
    assert np.array_equal(photo.stored, turn_upright(values, 6))
    write_photo(tmp_path / "out.png", photo.pixels, photo)
    assert np.array_equal(read_photo(tmp_path / "out.png").stored, photo.stored)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_on_a_pillow_image_and_kept(orientation: int, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = orientation, "camera"
    exif.get_ifd(0x8769)[0x829A] = 0.01
    Image.fromarray(picture()).save(tmp_path / "in.png", exif=exif)
    with Image.open(tmp_path / "in.png") as image:
        photo = from_pillow(image)
        assert np.array_equal(photo.stored, np.asarray(ImageOps.exif_transpose(image)))
    for name in ("out.jpg", "out.png", "out.tif", "out.webp"):
        write_photo(tmp_path / name, photo.pixels, photo)
        with Image.open(tmp_path / name) as image:
            found = image.getexif()
            assert found.get(0x0112, 1) == 1, name
            assert found[0x010F] == "camera"
            assert float(found.get_ifd(0x8769)[0x829A]) == pytest.approx(0.01)
            assert image.size == photo.stored.shape[1::-1]
    assert to_pillow(photo, photo.pixels).size == photo.stored.shape[1::-1]
    assert to_pillow(photo, photo.pixels).getexif()[0x010F] == "camera"


def test_broken_settings_but_a_good_orientation(tmp_path: Path) -> None:
    entries = struct.pack("<HHII", 0x0112, 3, 1, 6) + struct.pack("<HHII", 0x8769, 4, 1, 0xFFFFFF)
    raw = b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<H", 2) + entries + bytes(4)
    Image.fromarray(picture()).save(tmp_path / "in.jpg", exif=raw)
    photo = read_photo(tmp_path / "in.jpg")
    assert photo.stored.shape == (30, 20, 3)
    write_photo(tmp_path / "out.jpg", photo.pixels, photo)
    assert read_photo(tmp_path / "out.jpg").stored.shape == (30, 20, 3)


def test_exif_of_a_tiff_says_nothing_of_its_strips(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x010F] = "camera"
    Image.fromarray(picture()).save(tmp_path / "in.tif", exif=exif, dpi=(240, 240))
    write_photo(tmp_path / "out.jpg", *(lambda photo: (photo.pixels, photo))(read_photo(tmp_path / "in.tif")))
    with Image.open(tmp_path / "out.jpg") as image:
        assert dict(image.getexif()) == {0x010F: "camera"}
        assert image.info["dpi"] == (240, 240)


def test_broken_exif_is_left_out(tmp_path: Path) -> None:
    start = b"Exif\0\0II*\0\x08\0\0\0"
    for junk in (b"Exif\0\0", b"Exif\0\0MM\0*\0\0\xff\xff", start + b"\xff\xff" + bytes(40), b"nonsense"):
        Image.fromarray(picture()).save(tmp_path / "in.jpg", exif=junk)
        photo = read_photo(tmp_path / "in.jpg")
        assert photo.stored.shape == (20, 30, 3)
        write_photo(tmp_path / "out.tif", photo.pixels, photo)


def test_thumbnail_of_the_old_light_is_left_out(tmp_path: Path) -> None:
    entry = struct.pack("<HHII", 0x0103, 3, 1, 6)
    raw = b"II*\0\x08\0\0\0" + struct.pack("<H", 1) + struct.pack("<HHII", 0x0112, 3, 1, 1) + struct.pack("<I", 26)
    raw += struct.pack("<H", 1) + entry + bytes(4)
    Image.fromarray(picture()).save(tmp_path / "in.jpg", exif=b"Exif\0\0" + raw)
    photo = read_photo(tmp_path / "in.jpg")
    found = Image.Exif()
    found.load(photo.exif)
    assert not found.get_ifd(1)


@pytest.mark.parametrize("name", ["g.png", "g.jpg", "g.tif", "g.bmp", "g.pgm"])
def test_grey_stays_grey(name: str, tmp_path: Path) -> None:
    Image.fromarray(picture()).convert("L").save(tmp_path / name)
    photo = read_photo(tmp_path / name)
    coloured = relit(photo.pixels)
    coloured[5:15, 5:15, 2] //= 2  # a lamp of a colour: luminance is kept
    write_photo(tmp_path / f"out_{name}", coloured, photo)
    with Image.open(tmp_path / f"out_{name}") as image:
        assert image.mode == "L"
    assert to_pillow(photo, coloured).mode == "L"
    if name != "g.jpg":
        assert np.array_equal(outside(read_photo(tmp_path / f"out_{name}").stored), outside(photo.stored))


def test_grey_profile(tmp_path: Path) -> None:
    Image.fromarray(picture()).convert("L").save(tmp_path / "g.png", icc_profile=GREY)
    photo = read_photo(tmp_path / "g.png")
    assert photo.icc == GREY
    write_photo(tmp_path / "out.png", relit(photo.pixels), photo)
    again = read_photo(tmp_path / "out.png")
    assert again.icc == GREY
    assert np.array_equal(outside(again.stored), outside(photo.stored))
    assert np.abs(again.pixels.astype(int) - relit(photo.pixels)).max() <= 2
    write_photo(tmp_path / "out.webp", photo.pixels, photo)
    assert read_photo(tmp_path / "out.webp").icc is None


def test_cmyk_stays_cmyk(tmp_path: Path) -> None:
    stored = NOISE.integers(0, 256, (20, 30, 4)).astype(np.uint8)
    Image.frombytes("CMYK", (30, 20), stored.tobytes()).save(tmp_path / "c.tif")
    photo = read_photo(tmp_path / "c.tif")
    assert photo.mode == "CMYK"
    write_photo(tmp_path / "out.tif", relit(photo.pixels), photo)
    again = read_photo(tmp_path / "out.tif")
    assert again.mode == "CMYK"
    assert np.array_equal(outside(again.stored), outside(stored))
    assert np.abs(again.pixels.astype(int) - relit(photo.pixels)).max() <= 3
    write_photo(tmp_path / "out.png", photo.pixels, photo)
    assert np.array_equal(read_photo(tmp_path / "out.png").stored, photo.pixels)
    assert not_held("out.png", photo) == ["PNG holds no CMYK: converted to sRGB"]


def lab_table(inputs: int, nodes: np.ndarray) -> bytes:
    """A lut8Type of straight curves: ``nodes (grid ** inputs, outputs)`` uint8."""
    grid, outputs = round(len(nodes) ** (1 / inputs)), nodes.shape[1]
    matrix = struct.pack(">9i", *(65536 * (k % 4 == 0) for k in range(9)))
    straight = bytes(range(256))
    head = b"mft1\0\0\0\0" + bytes((inputs, outputs, grid, 0)) + matrix
    return head + straight * inputs + nodes.astype(np.uint8).tobytes() + straight * outputs


def cmyk_profile() -> bytes:
    """A press that prints as Pillow thinks of CMYK, coarsely."""
    lab, srgb = ImageCms.createProfile("LAB"), ImageCms.createProfile("sRGB")
    steps = np.linspace(0, 255, 9).astype(np.uint8)
    inks = np.stack(np.meshgrid(*[steps[::2]] * 4, indexing="ij"), -1).reshape(1, -1, 4)
    to_lab, to_rgb = (ImageCms.buildTransform(*pair) for pair in ((srgb, lab, "RGB", "LAB"), (lab, srgb, "LAB", "RGB")))
    seen = ImageCms.applyTransform(Image.frombytes("CMYK", inks.shape[1::-1], inks.tobytes()).convert("RGB"), to_lab)
    forth = np.asarray(seen)[0] ^ np.array((0, 128, 128), np.uint8)  # Pillow's a and b are signed
    colours = np.stack(np.meshgrid(*[steps] * 3, indexing="ij"), -1).reshape(1, -1, 3)
    signed = colours ^ np.array((0, 128, 128), np.uint8)
    rgb = ImageCms.applyTransform(Image.frombytes("LAB", signed.shape[1::-1], signed.tobytes()), to_rgb)
    back = PlainCmyk().encode(SRGB.decode(np.asarray(rgb)[0] / 255)) * 255
    tags = {b"desc": b"desc\0\0\0\0" + struct.pack(">I", 5) + b"test\0" + bytes(78), b"cprt": b"text\0\0\0\0none\0"}
    tags |= {b"A2B0": lab_table(4, forth), b"B2A0": lab_table(3, np.rint(back))}
    tags[b"wtpt"] = b"XYZ \0\0\0\0" + struct.pack(">3i", 63190, 65536, 54061)
    return assembled(tags, b"prtr", b"CMYK", b"Lab ")


def test_cmyk_profile(tmp_path: Path) -> None:
    profile = cmyk_profile()
    smooth = cv2.GaussianBlur(NOISE.integers(0, 256, (20, 30, 4)).astype(np.uint8), (0, 0), 3)
    Image.frombytes("CMYK", (30, 20), smooth.tobytes()).save(tmp_path / "c.tif", icc_profile=profile)
    photo = read_photo(tmp_path / "c.tif")
    assert type(photo.profile) is TableProfile
    for name in ("out.tif", "out.jpg"):
        write_photo(tmp_path / name, relit(photo.pixels), photo)
        again = read_photo(tmp_path / name)
        assert again.mode == "CMYK"
        assert again.icc == profile
        assert np.abs(again.pixels.astype(int) - relit(photo.pixels)).mean() < 4
    assert np.array_equal(outside(read_photo(tmp_path / "out.tif").stored), outside(smooth))


def test_palette_and_float(tmp_path: Path) -> None:
    Image.fromarray(picture()).convert("P").save(tmp_path / "p.png")
    palette = read_photo(tmp_path / "p.png")
    write_photo(tmp_path / "p2.png", palette.pixels, palette)
    assert np.array_equal(read_photo(tmp_path / "p2.png").stored, palette.stored)
    values = NOISE.random((20, 30), dtype=np.float32)
    Image.fromarray(values).save(tmp_path / "f.tif")
    photo = read_photo(tmp_path / "f.tif")
    write_photo(tmp_path / "f2.tif", relit(photo.pixels), photo)
    again = read_photo(tmp_path / "f2.tif")
    assert again.stored.dtype == np.float32
    assert np.array_equal(outside(again.stored), outside(values))
    assert np.abs(again.pixels.astype(int) - relit(photo.pixels)).max() <= 2
    write_photo(tmp_path / "f3.png", photo.pixels, photo)
    assert read_photo(tmp_path / "f3.png").bits == 16


def test_alpha_to_jpeg_shows_no_hidden_colour(tmp_path: Path) -> None:
    whole = np.dstack((np.full((20, 30, 3), (255, 0, 0)), np.zeros((20, 30)))).astype(np.uint8)
    whole[:, :10, 3] = 255
    Image.fromarray(whole).save(tmp_path / "in.png")
    photo = read_photo(tmp_path / "in.png")
    assert "white" in not_held("out.jpg", photo)[0]
    for name in ("out.jpg", "out.bmp"):
        write_photo(tmp_path / name, photo.pixels, photo)
        seen = np.asarray(Image.open(tmp_path / name).convert("RGB"))
        assert seen[:, 20:].min() > 250
        assert seen[:, :8, 1].max() < 10
    write_photo(tmp_path / "out.webp", photo.pixels, photo)
    assert np.array_equal(read_photo(tmp_path / "out.webp").stored_alpha, whole[..., 3])


@pytest.mark.skipif(not features.check("avif"), reason="this Pillow has no AVIF")
def test_avif(tmp_path: Path) -> None:
    smooth = np.repeat(np.linspace(0, 255, 64).astype(np.uint8)[None, :, None], 64, 0).repeat(3, 2)
    Image.fromarray(smooth).save(tmp_path / "in.avif", quality=95, icc_profile=WIDE)
    photo = read_photo(tmp_path / "in.avif")
    assert photo.icc == WIDE
    write_photo(tmp_path / "out.avif", photo.pixels, photo)
    assert np.abs(read_photo(tmp_path / "out.avif").rgb - photo.rgb).mean() < 0.01


@pytest.mark.parametrize("name", ["deep.png", "deep.tif", "in.avif"])
def test_broken_files_are_refused_or_read(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "in.avif":
        if not features.check("avif"):
            pytest.skip("this Pillow has no AVIF")
        Image.fromarray(picture()).save(path)
    else:
        with path.open("wb") as file:
            values = NOISE.integers(0, 65536, (20, 30, 3)).astype(np.uint16)
            (write_png if name == "deep.png" else write_tiff)(file, values, WIDE, None, None)
    whole = path.read_bytes()
    for length in range(1, len(whole) - 12, max(len(whole) // 60, 1)):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=f"{name}: expected"):
            read_photo(path)
    for place in range(0, len(whole), max(len(whole) // 60, 1)):
        path.write_bytes(whole[:place] + b"\xff\x00\x80" + whole[place + 3 :])
        try:
            photo = read_photo(path)
        except ValueError as refused:
            message = str(refused)
        else:
            message = f"{path}: expected"
            assert np.isfinite(photo.rgb).all()
        assert message.startswith(f"{path}: expected")


def test_heic_names_the_plug_in(tmp_path: Path) -> None:
    path = tmp_path / "in.heic"
    path.write_bytes(struct.pack(">I", 24) + b"ftypheic" + bytes(12))
    with pytest.raises(ValueError, match=r"in\.heic: expected .*(pip install pillow-heif|readable)"):
        read_photo(path)


def test_bad_profile_space_and_shapes(tmp_path: Path) -> None:
    photo = PhotoFile(picture())
    with pytest.raises(ValueError, match=r"expected \(20, 30, 3\) uint8"):
        photo.relit(picture((4, 4)))
    with pytest.raises(ValueError, match="uint16"):
        photo.relit(picture().astype(np.uint16))
    for name in ("x.gif", "x.xyz", "x"):
        with pytest.raises(ValueError, match="image file name"):
            check_writable(tmp_path / name)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="folder"):
        check_writable(tmp_path / "file" / "x.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ValueError, match="folder"):
        check_writable(tmp_path / "folder.png")
    assert check_writable(tmp_path / "new" / "deep" / "x.JPG") == "JPEG"


def test_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_photo(tmp_path / "x.png", picture())
    before = (tmp_path / "x.png").read_bytes()

    def full(self: Image.Image, path: Path, **_: object) -> None:
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(ValueError, match="No space left"):
        write_photo(tmp_path / "x.png", 255 - picture())
    assert (tmp_path / "x.png").read_bytes() == before
    assert find_photos(tmp_path) == [tmp_path / "x.png"]
    assert len(list(tmp_path.iterdir())) == 1


def test_jpeg_is_written_without_subsampling() -> None:
    buffer = io.BytesIO()
    Image.fromarray(picture()).save(buffer, "JPEG", quality=95, subsampling=0)
    with Image.open(buffer) as image:
        layers = image.layer  # type: ignore[attr-defined]
    assert all(layer[1:3] == (1, 1) for layer in layers)
