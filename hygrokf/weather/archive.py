"""Read a weather file, unpacked from ZIP or gzip within limits, and recognise its kind.

An archive is unpacked in memory, piece by piece, up to a limit of size and ratio; sizes stated in the archive
are not trusted, and none of its paths is written to.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TypeVar

from hygrokf.data.columns import TableFault
from hygrokf.data.table_readers import file_bytes

MOST_BYTES = 2**31
"""[bytes] largest file, packed or unpacked; a decade of hourly fields on one country's grid has 1 GB."""
MOST_RATIO = 200.0
"""[1] largest ratio of unpacked to packed size; text has about 10, a ZIP bomb about 1000."""
RATIO_FROM = 2**20
"""[bytes] unpacked size from which on the ratio is checked; smaller files do no harm."""
MOST_MEMBERS = 400
"""Largest number of files in an archive: more than a year of daily files."""
_PIECE = 2**20
"""[bytes] unpacked at a time."""
FORMATS_OF_KINDS = {"netcdf4": "era5", "netcdf3": "era5", "epw": "epw", "json": "open_meteo"}
"""Kind of a file → the only format of weather files of this kind."""
T = TypeVar("T")


@dataclass(frozen=True)
class FileContent:
    """The content of a file, or of one member of an archive.

    member: name in the archive, "" for the file itself. kind: see `archive_kind`. data: all bytes.
    """

    member: str
    kind: str
    data: bytes


def contents(path: Path) -> tuple[tuple[FileContent, ...], str]:
    """Return the contents of a weather file, and the SHA-256 of the file itself.

    path: NetCDF or text, plain, as gzip or in a ZIP archive; recognised by the first bytes, not by the name.

    Raises TableFault with every fault and, for an archive, its member.
    """
    packed_bytes = _packed(path)
    digest = hashlib.sha256(packed_bytes).hexdigest()
    if packed_bytes[:4] in (b"PK\x03\x04", b"PK\x05\x06"):
        return _members(packed_bytes), digest
    data = packed_bytes
    if packed_bytes[:2] == b"\x1f\x8b":
        try:
            with gzip.GzipFile(fileobj=io.BytesIO(packed_bytes)) as stream:
                data = _bounded(stream, len(packed_bytes), MOST_BYTES)
        except (OSError, EOFError, zlib.error) as fault:
            raise TableFault(f"cannot be unpacked: {fault}; fetch it again") from None
    return (FileContent("", archive_kind(data), data),), digest


def read_each(file_contents: Sequence[FileContent], read: Callable[[FileContent], T]) -> list[T]:
    """Return the results of `read` for all contents. Raises TableFault with all faults, each with the name of
    its member."""
    results, faults = [], []
    for content in file_contents:
        try:
            results.append(read(content))
        except TableFault as fault:
            faults += [
                f"{content.member}: {message}" if content.member else message for message in fault.faults
            ]
    if faults:
        raise TableFault(*faults)
    return results


def only_content(path: Path, kinds: Sequence[str], description: str) -> tuple[FileContent, str]:
    """Return the only content of the given kinds in a file or archive, and the SHA-256 of the file.

    description: of such a content, for messages. Raises TableFault if there is none, or more than one.
    """
    file_contents, digest = contents(path)
    matching = [content for content in file_contents if content.kind in kinds]
    if not matching:
        file_format = FORMATS_OF_KINDS.get(file_contents[0].kind)
        remedy = f'; state format = "{file_format}"' if file_format else ""
        raise TableFault(f"expected {description}, found {file_contents[0].kind}{remedy}")
    if len(matching) > 1:
        raise TableFault(f"holds {len(matching)} such files; expected one: unpack the site's file")
    return matching[0], digest


def archive_kind(data: bytes) -> str:
    """Recognise the kind of a file by its first bytes: "netcdf4", "netcdf3", "epw", "json" or "csv" (any
    table of text).

    Raises TableFault that names any other kind.
    """
    if not data.strip(b"\x00 \r\n\t"):
        raise TableFault("the file is empty")
    if data[:8] == b"\x89HDF\r\n\x1a\n":
        return "netcdf4"
    if data[:4] in (b"CDF\x01", b"CDF\x02"):
        return "netcdf3"
    if data[:4] == b"CDF\x05":
        raise TableFault(
            "is a NetCDF file of the 64-bit data kind; convert it with: nccopy -k nc4 IN.nc OUT.nc"
        )
    if data[:4] == b"GRIB":
        raise TableFault('is a GRIB file; ask for data_format "netcdf", or convert it with: grib_to_netcdf')
    if data[:4] == b"PK\x03\x04":
        raise TableFault("is a ZIP archive in a ZIP archive; unpack it")
    first_bytes = data[:4096].removeprefix(b"\xef\xbb\xbf")
    if first_bytes.lstrip()[:1] in (b"{", b"[") and b'"hourly' in data:
        return "json"
    if first_bytes.lstrip()[:1] in (b"<", b"{"):
        beginning = " ".join(first_bytes[:200].decode("utf-8", "replace").split())[:60]
        raise TableFault(
            f'expected weather data, found "{beginning}…": an error page saved in place of the file?'
        )
    if b"\x00" in first_bytes:
        raise TableFault("expected NetCDF, CSV, EPW or a ZIP archive of these, found other bytes")
    return "epw" if first_bytes.lstrip()[:9].upper() == b"LOCATION," else "csv"


def _packed(path: Path) -> bytes:
    """Read a file. Raises TableFault if it is too large."""
    if path.is_file() and path.stat().st_size > MOST_BYTES:
        raise TableFault(_too_large("the file holds"))
    return file_bytes(path)


def _too_large(subject: str) -> str:
    """Return the message for a file of more than `MOST_BYTES`."""
    return f"{subject} more than {MOST_BYTES / 2**30:g} GiB: request a smaller area, or one file per year"


def _bounded(stream: IO[bytes] | gzip.GzipFile, packed_size: int, largest_size: int) -> bytes:
    """Return all bytes of a stream that unpacks `packed_size` bytes. Raises TableFault above `largest_size`
    or the ratio."""
    pieces, size = [], 0
    while piece := stream.read(_PIECE):
        size += len(piece)
        if size > largest_size:
            raise TableFault(_too_large("it unpacks to"))
        if size > RATIO_FROM and size > MOST_RATIO * max(packed_size, 1):
            raise TableFault(
                f"it unpacks to more than {MOST_RATIO:g} times its size: this is not a weather file"
            )
        pieces.append(piece)
    return b"".join(pieces)


def _members(packed_bytes: bytes) -> tuple[FileContent, ...]:
    """Return the contents of all files in a ZIP archive. Raises TableFault with the faults of all members."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(packed_bytes))
    except (zipfile.BadZipFile, struct.error, ValueError, OSError) as fault:
        raise TableFault(f"is a damaged ZIP archive ({fault}); fetch it again") from None
    with archive:
        members = [member for member in archive.infolist() if not member.is_dir()]
        if len(members) > MOST_MEMBERS:
            raise TableFault(f"holds {len(members)} files; expected no more than {MOST_MEMBERS}")
        file_contents, faults, bytes_left = [], [], MOST_BYTES
        for member in members:
            try:
                data = _member(archive, member, bytes_left)
                file_contents.append(FileContent(member.filename, archive_kind(data), data))
                bytes_left -= len(data)
            except TableFault as fault:
                faults += [f"{member.filename}: {message}" for message in fault.faults]
                if len(faults) > 4:
                    break
    if faults:
        raise TableFault(*faults)
    if not file_contents:
        raise TableFault("is a ZIP archive without a file in it; fetch it again")
    return tuple(file_contents)


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, largest_size: int) -> bytes:
    """Return the bytes of one member of an archive. Raises TableFault if it cannot be unpacked."""
    if member.flag_bits & 1:
        raise TableFault("is encrypted; unpack it first")
    try:
        with archive.open(member) as stream:
            return _bounded(stream, member.compress_size, largest_size)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError) as fault:
        raise TableFault(f"is damaged ({fault}); fetch the archive again") from None
    except (NotImplementedError, RuntimeError) as fault:
        raise TableFault(f"cannot be unpacked here ({fault}); unpack it first") from None
