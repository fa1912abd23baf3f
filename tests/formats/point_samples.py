"""Point files as bytes."""

import io
import struct

import numpy as np

POINTS = np.array([[1.5, -2.0, 0.25, 0.5], [70.0, 39.5, -3.0, 1.0], [0.0, 1e-3, -0.1, 0.0]], np.float32)


def make_cloud(rng: np.random.Generator, count: int) -> np.ndarray:
    """A cloud with a ground, walls and intensities in [0, 1] as float32, in the order of its beams."""
    azimuth, distance = rng.uniform(-0.7, 0.7, count), rng.gamma(2.0, 8.0, count) + 3
    height = np.where(rng.random(count) < 0.6, rng.normal(-1.7, 0.05, count), rng.uniform(-1.7, 2, count))
    cloud = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height, rng.beta(1, 3, count)], -1)
    return cloud[np.argsort(height / distance, kind="stable")].astype(np.float32)


def saved(write, *arrays, **named) -> bytes:
    stream = io.BytesIO()
    write(stream, *arrays, **named)
    return stream.getvalue()


def structured(array: np.ndarray, names: str) -> np.ndarray:
    return np.rec.fromarrays(array.T, names=names.split()).view(np.ndarray)


def ascii_rows(array: np.ndarray) -> bytes:
    return "\n".join(" ".join(map(repr, row)) for row in array.tolist()).encode() + b"\n"


def pcd(body: bytes, *, fields="x y z intensity", size="4 4 4 4", kind="F F F F", storage="ascii", **entries):
    header = {
        "VERSION": ".7",
        "FIELDS": fields,
        "SIZE": size,
        "TYPE": kind,
        "WIDTH": 3,
        "HEIGHT": 1,
        "POINTS": 3,
    }
    header |= {**entries, "DATA": storage}
    lines = [f"{key} {value}" for key, value in header.items() if value is not None]
    return "\n".join(["# .PCD v.7 - Point Cloud Data file format", *lines, ""]).encode() + body


def compressed(raw: bytes) -> bytes:
    packed = compress_lzf(raw)
    return struct.pack("<II", len(packed), len(raw)) + packed


def compress_lzf(raw: bytes) -> bytes:
    """Compress greedily, each three bytes by their last occurrence; long runs repeat their own output."""
    output, literals, seen, at = bytearray(), bytearray(), dict[bytes, int](), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            output.extend((len(run) - 1, *run))
        literals.clear()

    while at < len(raw):
        start = seen.get(raw[at : at + 3], -1)
        seen[raw[at : at + 3]] = at
        if start < 0 or at - start > 8192 or len(raw) - at < 3:
            literals.append(raw[at])
            at += 1
            continue
        length = 3
        while length < 264 and at + length < len(raw) and raw[start + length] == raw[at + length]:
            length += 1
        flush()
        high, low = divmod(at - start - 1, 256)
        output.extend(((length - 2) << 5 | high, low) if length < 9 else (7 << 5 | high, length - 9, low))
        at += length
    flush()
    return bytes(output)


def ply(body: bytes, *, properties="float x,float y,float z,float intensity", storage="ascii", before=(), after=()):
    vertex = ["element vertex 3", *(f"property {one}" for one in properties.split(",") if one)]
    return (
        "\n".join(
            ["ply", f"format {storage} 1.0", "comment made up", *before, *vertex, *after, "end_header", ""]
        ).encode()
        + body
    )


BY_COLUMN = POINTS.T.astype("<f4").tobytes()
LITTLE, BIG = POINTS.astype("<f4").tobytes(), POINTS.astype(">f4").tobytes()
FACES = ("element face 1", "property list uchar int vertex_indices")
SENSOR = ("element sensor 1", "property uchar id", "property double time")

# Each holds POINTS.
GOOD = {
    "a.bin": LITTLE,
    "A.BIN": LITTLE,
    "a.npy": saved(np.save, POINTS),
    "wide.npy": saved(np.save, np.pad(POINTS.astype(np.float64), ((0, 0), (0, 2)))),
    "fortran.npy": saved(np.save, np.asfortranarray(POINTS)),
    "named.npy": saved(np.save, structured(POINTS[:, [3, 0, 1, 2]].astype(np.float64), "Reflectivity X Y Z")),
    "one.npz": saved(np.savez, POINTS),
    "named.npz": saved(np.savez_compressed, other=np.zeros(3), points=POINTS),
    "ascii.pcd": pcd(ascii_rows(POINTS)),
    "order.pcd": pcd(ascii_rows(POINTS[:, [3, 2, 1, 0]]), fields="Reflectance Z Y X", kind="f f f f"),
    "lower.pcd": pcd(ascii_rows(POINTS)).replace(b"FIELDS", b"fields").replace(b"DATA ascii", b"data ASCII"),
    "old.pcd": pcd(ascii_rows(POINTS), POINTS=None),
    "binary.pcd": pcd(LITTLE, storage="binary"),
    "newline.pcd": pcd(LITTLE + b"\n", storage="binary"),
    "packed.pcd": pcd(compressed(BY_COLUMN), storage="binary_compressed"),
    "ascii.ply": ply(ascii_rows(POINTS)),
    "carriage.ply": ply(ascii_rows(POINTS)).replace(b"\n", b"\r\n"),
    "little.ply": ply(LITTLE, storage="binary_little_endian"),
    "big.ply": ply(BIG, storage="binary_big_endian"),
    "faces.ply": ply(ascii_rows(POINTS) + b"3 0 1 2\n", after=FACES),
    "packed_faces.ply": ply(LITTLE + b"\3" + bytes(12), storage="binary_little_endian", after=FACES),
    "sensor.ply": ply(b"7 0.5\n" + ascii_rows(POINTS), before=SENSOR),
    "packed_sensor.ply": ply(bytes(9) + BIG, storage="binary_big_endian", before=SENSOR),
    "compare.ply": ply(
        ascii_rows(POINTS[:, [0, 1, 2, 0, 3]]),
        properties="float x,float y,float z,uchar red,float scalar_Intensity",
    ),
}
