"""ArduPilot's answer to "is the table current?": the checksum of its parameter file.

MAVFTP's CalcFileCRC32 returns the CRC-32 of `@PARAM/param.pck`, of all parameters or of a range of them, in
one round trip and without opening the file. The same file is encoded from the table. The checksum is linear:
where one value of a range differs, its new bits follow from each row in which it may be, and the row in which
these are a simple value is probably the one.

Such a value can also make up for other changes, and no checksum would show it. So each is read by its index
too, but for those that always move by little: their rows are compared alone, or at the end of a short range.
Nothing is taken over until the checksums of all ranges agree.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator
from itertools import pairwise
from typing import Final

import anyio

from paramclient.errors import FileErrorCode, FileTransferError, NoReply, VehicleError
from paramclient.model.px4_hash import crc32_px4, crc32_px4_before
from paramclient.model.values import ParamType, Trust, as_reported, bits_of, bits_of_wire, from_bits
from paramclient.protocol.channel import task_group
from paramclient.protocol.ftp import BUSY, checksum, is_free
from paramclient.protocol.param_pck import PACKABLE, PARAM_FILE, PackedParam, encode_entries, header
from paramclient.protocol.reads import READS_PER_SLOT_ARDUPILOT, SLOT_ARDUPILOT, read
from paramclient.protocol.session import UNANSWERED, FileUnavailable, Session
from paramclient.protocol.table import Table

CHECKED_READ_SIZE: Final = 64
"""Bytes that ArduPilot reads at a time for a checksum: the padding of the file depends on it (measured)."""
AT_ONCE: Final = 5
"""Requests sent at once: ArduPilot queues no more of them (GCS_FTP.cpp)."""
INTERVAL_FIRST: Final = 0.027
"""Seconds from these to the next request: a Plane and a Rover look for requests every 20 ms (measured)."""
INTERVAL: Final = 0.006
"""Seconds between further requests: ArduPilot loses some of those sent every 4 ms (measured)."""
REQUEST_SIZE: Final = 65
"""Bytes of a request on the link, for a range."""
FILE_ROUND_TRIPS: Final = 3
"""Round trips of a download: to open the file, to its first block, and to close it."""
FILE_RATE: Final = 48_500
"""Bytes per second of a download where the link does not limit it (measured)."""
BOOT_COUNT: Final = "STAT_BOOTCNT"
SECONDS: Final = re.compile("STAT_RUNTIME|STAT_FLTTIME")
"""Names of values that count seconds."""
PRESSURE: Final = re.compile(r"BARO\d_GND_PRESS")
"""Names of values that a disarmed Plane or Rover measures all the time (measured)."""
PLANES_AND_ROVERS: Final = frozenset({1, 10, 11})
"""MAV_TYPE of these, boats included."""
PRESSURE_DRIFT: Final = 0.001
"""Share by which these change in between."""
PRESSURE_CHANGE: Final = 0.3
"""Share by which they change between days and places: the checksum of one row alone shows its value."""
SECONDS_SLACK: Final = 40.0
"""By how much these may differ from the time that has passed: they are stored every 30 s."""
PASSED_MAX: Final = 86_400.0
"""Seconds passed up to which fewer may have been counted: of a year, one in a hundred values fits."""
MEASURED_ONCE: Final = re.compile(r"INS_GYR\d?OFFS_[XYZ]|INS_GYR\d_CALTEMP|ARSPD\d?_OFFSET|COMPASS_DEC")
MEASURED: Final = re.compile(f"{MEASURED_ONCE.pattern}|{PRESSURE.pattern}")
"""Names that each start of the vehicle measures again (measured)."""
OFTEN_MAX: Final = 8
"""Values changed at once that may have moved by themselves: of more, somebody has changed them."""
TOO_MANY: Final = "it differs, and a download is quicker than a search for the changes"
OTHER: Final = "the vehicle has other parameters than the cached table, or changes them all the time"
PROOFS_MAX: Final = 3
"""Proofs: the table may change in the middle of one, and the vehicle may restart in the next."""
RESTART_TIME: Final = 1.0
"""Seconds that a vehicle's restart takes at least, after which other values may be in parts proven before."""
REPEATS_MAX: Final = 3
"""Checksums of single values that are requested again, as these may just have moved."""
PARTS_MIN: Final = 3
PARTS_MAX: Final = 12
"""Parts into which a range that differs is divided."""
PART_TIME: Final = 0.008
"""Seconds of round trip for each of these: on a quick link few parts take the fewest bytes, and on a slow one
many parts take the fewest round trips."""
SLOW_ROUND_TRIP: Final = 0.05
"""Seconds of round trip from which on more is compared at once."""
GUESS_BITS: Final = 26
"""Bits of a value, and of the number of rows in which it may be, up to which a guess is hardly chance: in
each wrong row, any of 2**32 values would explain the difference."""
GUESS_BITS_SHORT: Final = 29
"""The same in a short range, where hardly two values differ."""


class TableDiffers(FileUnavailable):
    """The vehicle's table is another one, and a search is not worth it."""


async def prove(session: Session) -> None:
    """Prove a complete table by the vehicle's checksum, after reading the values that have changed.

    Raises:
        FileUnavailable: the vehicle computes no checksum now.
        TableDiffers: its table is too different.
        LinkError: the link is closed for good.
    """
    vehicles = session.identification.vehicles
    if not await is_free(session.channel):
        raise FileUnavailable(BUSY)
    async with session.channel.ftp:
        try:
            for _ in range(PROOFS_MAX):
                proof = _Proof(session, _rows(session.table))
                is_at_once = await proof.run() or anyio.current_time() - proof.first < RESTART_TIME
                if session.identification.vehicles != vehicles:
                    raise FileUnavailable("another vehicle has taken the address")
                if proof.take_over() and is_at_once:
                    return
        except FileTransferError as error:
            if error.code == FileErrorCode.FAIL_ERRNO and session.serves_checksum:
                raise TableDiffers(OTHER) from None  # a range is beyond the end
            if error.code == FileErrorCode.UNKNOWN_COMMAND:
                session.serves_checksum = False
            is_busy = error.code == FileErrorCode.INVALID_SESSION
            raise FileUnavailable(BUSY if is_busy else f"the checksum was refused: {error.reason}") from None
        except NoReply as error:
            session.ftp_unanswered += error.attempts
            raise FileUnavailable(UNANSWERED, is_silent=session.serves_checksum is None) from None
    raise TableDiffers(OTHER)


def is_moving(name: str) -> bool:
    """Return whether ArduPilot changes this value itself, at each start or all the time."""
    return name == BOOT_COUNT or bool(SECONDS.fullmatch(name) or MEASURED.fullmatch(name))


class _Proof:
    """One proof: the rows as the vehicle must have them, which are brought in line with its checksums."""

    def __init__(self, session: Session, rows: list[PackedParam]) -> None:
        self._session = session
        self._rows = rows
        self._found: dict[range, int] = {}  # the vehicle's checksums of ranges, which may differ
        self._encoded: dict[range, list[bytes]] = {}  # the rows of a range, behind its header
        self._changed: dict[int, float] = {}  # by index, when the value was known
        self._refuted: set[tuple[int, int]] = set()  # wrong guesses
        self.first = math.inf  # when the first checksum arrived
        self._round_trip = math.inf  # of the quickest requests
        self._byte_time = 0.0  # seconds for each byte of requests that waited for each other
        table, now = session.table, anyio.current_time()
        measures = session.identification.vehicle_type in PLANES_AND_ROVERS
        self._always = self._named(PRESSURE) if measures else set[int]()  # rows that always move
        seconds = self._named(SECONDS)
        names = {BOOT_COUNT, *table.volatile, *table.rounded}
        # rows that may have moved
        self._moving = self._always | seconds | {at for at, row in enumerate(rows) if row.name in names}
        is_first = any(param.trust is Trust.CACHED for param in table.params.values())
        is_slow = is_first and (session.channel.timing.round_trip or 0.0) > SLOW_ROUND_TRIP
        passed = {at for at in seconds if is_first and now - table.moments.get(rows[at].name, now) >= 1}
        # compared first; 0 shows the count, unless a range before the values that always move does
        self._alone = passed | ({0} if is_slow and not self._always else set())

    async def run(self) -> bool:
        """Compare, and read what differs, until nothing does. Return whether one checksum proves all rows.

        Raises:
            TableDiffers: the tables are too different.
        """
        rows, whole, repeats, suspects = self._rows, range(len(self._rows)), 0, set[int]()
        ends = {0, len(rows), *sorted(self._always)[:1], *(at + 1 for at in self._always)}
        between = {range(*each) for each in pairwise(sorted(ends))}
        await self._request(between | {range(at, at + 1) for at in self._alone})
        while places := self._differing():
            if len(places) > 1:
                places.pop(whole, None)  # its parts say more
            moved = [each for item in places.items() for each in self._guess_moved(*item)]
            for at, bits in moved:
                self._take(at, bits, anyio.current_time())
            if moved:
                continue
            if any(len(place) == 1 and rows[place.start].name == BOOT_COUNT for place in places):
                suspects = self._named(MEASURED)
            is_other = not self._found.keys() - places - {whole}
            guesses: dict[int, int] = {}
            parts: set[range] = set()
            divided: list[range] = []
            for place, difference in places.items():
                if len(place) > 1 and (suspected := suspects.intersection(place)):
                    guesses |= {at: rows[at].bits for at in suspected}
                elif guess := self._guess(place, difference):
                    guesses |= guess
                elif len(place) > 1:
                    moving = self._moving - (self._alone if place in between else set())
                    ends = {end for at in moving for end in (at, at + 1)}.intersection(place[1:])
                    if not ends:
                        divided.append(place)
                    parts |= self._divide(place, ends)
                elif is_other or repeats == REPEATS_MAX:
                    raise TableDiffers(OTHER)
                else:
                    parts.add(place)
                    repeats += 1
            self._weigh(len(guesses), len(parts), divided)
            if parts:
                await self._request(parts)
            elif guesses:
                await self._read(guesses)
                suspects -= guesses.keys()
        return whole in self._found

    def _named(self, names: re.Pattern[str]) -> set[int]:
        """Return the rows with such names, but for those with a value of 0."""
        return {at for at, row in enumerate(self._rows) if row.bits and names.fullmatch(row.name)}

    @property
    def _parts(self) -> int:
        return min(max(PARTS_MIN, int(self._round_trip / PART_TIME)), PARTS_MAX)

    def _divide(self, place: range, ends: set[int]) -> set[range]:
        """Divide a range at these rows, and into parts of equal size."""
        del self._found[place]
        size = -(-len(place) // self._parts)
        ends = ends.union(range(place.start + size, place.stop, size))
        return {range(*each) for each in pairwise((place.start, *sorted(ends), place.stop))}

    def _entries(self, place: range) -> list[bytes]:
        if place not in self._encoded:
            rows = self._rows[place.start : place.stop]
            entries = encode_entries(rows, with_defaults=False, read_size=CHECKED_READ_SIZE)
            self._encoded[place] = list(entries)
        return self._encoded[place]

    def _checksum(self, place: range) -> int:
        return crc32_px4(b"".join((header(len(place), len(self._rows)), *self._entries(place))))

    def _differing(self) -> dict[range, int]:
        """Return the ranges whose checksums differ, with the difference."""
        differences = {place: found ^ self._checksum(place) for place, found in self._found.items()}
        return {place: difference for place, difference in differences.items() if difference}

    def _explanations(self, place: range, difference: int) -> Iterator[tuple[int, int]]:
        """Yield each index in a range, from the last, with the bits of a value that explains a difference
        alone.

        Raises:
            TableDiffers: the number of parameters in the header explains it.
        """
        for at, entry in zip(reversed(place), reversed(self._entries(place)), strict=True):
            row = self._rows[at]
            change = crc32_px4_before(difference, row.type.size)
            if not change >> 8 * row.type.size and (at, row.bits ^ change) not in self._refuted:
                yield at, row.bits ^ change
            difference = crc32_px4_before(difference, len(entry))
        if place.start == 0 and not crc32_px4_before(difference, 2) >> 16:
            raise TableDiffers(OTHER)

    def _guess_moved(self, place: range, difference: int) -> Iterator[tuple[int, int]]:
        """Yield the index and the bits of a value that has just moved as it always does, alone or last in
        its range: hardly anything else explains it, so that it needs no read."""
        row, now = self._rows[place[-1]], anyio.current_time()
        passed = now - self._session.table.moments.get(row.name, now)
        if len(place) == 1 or place[-1] in self._always:
            for at, bits in self._explanations(place, difference):
                if at == place[-1] and _has_just_moved(row, bits, passed, is_alone=len(place) == 1):
                    yield at, bits

    def _guess(self, place: range, difference: int) -> dict[int, int]:
        """Return the index and the bits of the simplest value that explains a difference alone, unless there
        is none, or it may be chance."""
        guess: dict[int, int] = {}
        bits = GUESS_BITS_SHORT if len(place) <= PARTS_MAX else GUESS_BITS
        bits_max = bits - math.log2(len(place)) if len(place) > 1 else math.inf
        for at, value in self._explanations(place, difference):
            size = _bits_to_write(value, self._rows[at].type)
            if size <= bits_max:
                guess, bits_max = {at: value}, size
        return guess

    def _weigh(self, reads: int, requests: int, divided: list[range]) -> None:
        """Compare the time of the whole search with that of a download.

        Where most values are not simple, each part is divided until one row is left. Before the first
        division, that is not known, and two rounds are likely.

        Raises:
            TableDiffers: the download is quicker.
        """
        trip, parts = self._round_trip, self._parts
        largest = max((len(each) for each in divided), default=0)
        is_narrow = 2 * largest < len(self._rows) and 2 * len(divided) > reads
        depths = [math.ceil(math.log(len(each), parts)) if is_narrow else 2 for each in divided]
        rounds = max(depths, default=bool(requests))
        requests += parts * (sum(depths) - len(depths))
        slots = 0.5 + reads // READS_PER_SLOT_ARDUPILOT
        search = (rounds + 1) * trip + requests * INTERVAL + slots * SLOT_ARDUPILOT
        size = sum(map(len, self._entries(range(len(self._rows)))))
        if search > FILE_ROUND_TRIPS * trip + max(1 / FILE_RATE, self._byte_time) * size:
            raise TableDiffers(TOO_MANY)

    async def _request(self, places: Collection[range]) -> None:
        """Request the vehicle's checksums of ranges."""
        session, whole = self._session, range(len(self._rows))
        attempts = session.ftp_attempts()
        ranges = sorted(places, key=len, reverse=True)

        async def request(place: range) -> None:
            query = "" if place == whole else f"?start={place.start}&count={len(place)}"
            self._found[place] = await checksum(session.channel, PARAM_FILE + query, attempts=attempts)
            session.serves_checksum, self.first = True, min(self.first, anyio.current_time())

        async with task_group() as tasks:
            for number, place in enumerate(ranges):
                if number >= AT_ONCE:
                    await anyio.sleep(INTERVAL if number > AT_ONCE else INTERVAL_FIRST)
                tasks.start_soon(request, place)
            sent_at = anyio.current_time()
            await anyio.sleep(0.003)  # the requests are sent first: the rows take milliseconds
            for place in (*ranges, whole):  # while the vehicle computes
                self._entries(place)
        elapsed = anyio.current_time() - sent_at
        self._round_trip = min(self._round_trip, elapsed)
        self._byte_time = (elapsed - self._round_trip) / (REQUEST_SIZE * len(ranges))

    async def _read(self, guesses: dict[int, int]) -> None:
        """Read values by their indices, and take over those that are others; `guesses` has their exact bits.

        Raises:
            TableDiffers: the vehicle has another parameter at such an index.
        """
        encoding, now = self._session.table.encoding, anyio.current_time()

        async def read_one(at: int, guess: int) -> None:
            row = self._rows[at]
            try:
                found = await read(self._session, at)
            except (NoReply, VehicleError):
                raise TableDiffers(OTHER) from None
            if (found.param_id, found.param_type) != (row.name, row.type):
                raise TableDiffers(OTHER)
            for bits in (guess, row.bits, bits_of_wire(found.raw, row.type, encoding)[0]):
                if as_reported(bits, row.type, encoding) == found.raw:
                    break
            if bits != guess:
                self._refuted.add((at, guess))
            self._take(at, bits, now)

        async with task_group() as tasks:
            for at, guess in guesses.items():
                tasks.start_soon(read_one, at, guess)

    def _take(self, at: int, bits: int, now: float) -> None:
        if bits != self._rows[at].bits:
            row = self._rows[at] = self._rows[at]._replace(bits=bits)
            value = bits.to_bytes(row.type.size, "little")
            for place, entries in self._encoded.items():
                if at in place:
                    entries[at - place.start] = entries[at - place.start][: -len(value)] + value
            self._changed[at] = now

    def take_over(self) -> bool:
        """Put the proven file into the table, and learn which values change; return False where the table has
        changed meanwhile."""
        table = self._session.table
        if table.count != len(self._rows):
            return False
        for at, moment in self._changed.items():
            row = self._rows[at]
            default = table.params[row.name].default
            bits = None if default is None else bits_of(default, row.type)
            table.store_entry(row._replace(default=bits), at, moment, with_defaults=False)
        current = _rows(table)
        for at in self._always:
            self._take(at, current[at].bits, 0.0)  # what the vehicle has announced meanwhile
        if current != self._rows:
            return False
        names = {self._rows[at].name for at in self._changed}
        if names and len(names) <= OFTEN_MAX:
            table.volatile = frozenset(name for name in names if not MEASURED_ONCE.fullmatch(name))
        table.prove(self._checksum(range(len(self._rows))))
        return True


def _has_just_moved(row: PackedParam, bits: int, passed: float, *, is_alone: bool) -> bool:
    """Return whether a value has grown by the seconds that have passed, or by fewer of them, as the vehicle
    was off meanwhile; or is the same day's pressure, or alone any pressure."""
    old, new = float(from_bits(row.bits, row.type)), float(from_bits(bits, row.type))
    if SECONDS.fullmatch(row.name) and row.type is ParamType.INT32:
        fewest = 1 if passed <= PASSED_MAX else passed - SECONDS_SLACK
        return new > old and fewest <= new - old <= passed + SECONDS_SLACK
    is_pressure = PRESSURE.fullmatch(row.name) and row.type is ParamType.REAL32
    return bool(is_pressure) and 0 < abs(new - old) <= (PRESSURE_CHANGE if is_alone else PRESSURE_DRIFT) * old


def _bits_to_write(bits: int, kind: ParamType) -> float:
    """Return how many bits it takes to write a value: few for those that people choose."""
    value = abs(float(from_bits(bits, kind)))
    digits = repr(value).partition("e")[0].replace(".", "").strip("0")
    if not 0 < value < math.inf:
        return 8 * kind.size if value else 0
    return min(1 + len(digits) * math.log2(10) + 2 * abs(math.log10(value)), 8 * kind.size)


def _rows(table: Table) -> list[PackedParam]:
    names = [table.names.get(index, "") for index in range(table.count or 0)]
    if not table.params.keys() >= set(names) or len(set(names)) < len(names):
        raise FileUnavailable("the list has a gap, a name twice, or one that no file can contain")
    params = [table.params[name] for name in names]
    if inexact := [each.name for each in params if each.is_raw or each.type not in PACKABLE]:
        raise FileUnavailable(f"the exact value of {inexact[0]} is not known, or of a type that no file has")
    return [PackedParam(each.name, each.type, each.bits) for each in params]
