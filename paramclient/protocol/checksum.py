"""ArduPilot's answer to "is the table current?": the checksum of its parameter file.

MAVFTP's CalcFileCRC32 returns the CRC-32 of `@PARAM/param.pck`, of all parameters or of a range, in one round
trip and without opening the file. The same file is encoded from the table. A CRC-32 behind known bytes
determines the last four: the checksum of one parameter shows its exact value, if name and type are known.
Values that move by themselves are found that way, and so are those that were changed. The checksum is linear:
such a value can also make up for another name or type, and no other checksum would show it. So each is read
by its index too. Nothing is taken over until the checksum of the whole file agrees.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Final

import anyio

from paramclient.errors import FileErrorCode, FileTransferError, NoReply, VehicleError
from paramclient.model.px4_hash import crc32_px4, crc32_px4_before
from paramclient.model.values import Encoding, ParamType, as_reported, bits_of, bits_of_wire, from_bits
from paramclient.protocol.ftp import BUSY, attempts_unproven, checksum, is_free
from paramclient.protocol.param_pck import PACKABLE, PARAM_FILE, PackedParam, encode
from paramclient.protocol.reads import read
from paramclient.protocol.session import Session
from paramclient.protocol.table import Table

__all__ = ["CHECKED_READ_SIZE", "ChecksumUnavailable", "TableDiffers", "may_be_rounded", "prove"]

CHECKED_READ_SIZE: Final = 64
"""Bytes that ArduPilot reads at a time for a checksum: the padding of the file depends on it (measured)."""
AT_ONCE: Final = 5
"""Requests sent at once: ArduPilot's queue has 5 places, and drops the surplus silently (measured)."""
INTERVAL: Final = 0.005
"""Seconds between further requests: ArduPilot keeps up with one in 3 ms (measured)."""
FLOAT32_EXACT: Final = 2**24
"""The largest integer up to which float32 holds all."""
BOOT_COUNT: Final = "STAT_BOOTCNT"
MOVING: Final = re.compile(r"STAT_RUNTIME|STAT_BOOTCNT")
"""Names that have another value at almost every connection: the seconds and the number of runs."""
MEASURED: Final = re.compile(
    r"INS_GYR\d?OFFS_[XYZ]|INS_GYR\d_CALTEMP|ARSPD\d?_OFFSET|COMPASS_DEC|BARO\d_GND_PRESS"
)
"""Names that each start of the vehicle measures again (measured)."""
MOVING_MAX: Final = 12
"""Values that are read one by one for their own sake; a table with more of them is downloaded."""
SEARCHES_MAX: Final = 4
"""Searches for changed values; each finds one at least."""
PLACES_MAX: Final = 4
"""Ranges that differ, at most, for a search to go on."""
TOO_MANY: Final = "it differs, and a download is quicker than a search for the changes"
OTHER: Final = "the vehicle has other parameters than the cached table"
PROOFS_MAX: Final = 2
"""Proofs: the vehicle may announce a change in the middle of one."""
PARTS_MAX: Final = 12
"""Parts of a range that one search compares at once."""
PART_TIME: Final = 0.01
"""Seconds of round trip for each further part: on a quick link halving takes the fewest bytes, and on a slow
one many parts take the fewest round trips."""
QUICK_ROUND_TRIP: Final = 0.05
"""Seconds of round trip up to which values that move are read before anything is searched."""
SEARCH_TIME_MAX: Final = 0.3
"""Seconds that the last requests took, above which a download of the file is quicker than a search."""


class ChecksumUnavailable(Exception):
    """The checksum cannot prove the table.

    Attributes:
        reason: why, as a sentence for the notes of a fetch.
        is_silent: whether MAVFTP did not answer at all.
    """

    def __init__(self, reason: str, *, is_silent: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.is_silent = is_silent


class TableDiffers(ChecksumUnavailable):
    """The vehicle's table is another one, and a search is not worth it."""


async def prove(session: Session) -> tuple[str, ...]:
    """Prove a complete table by the vehicle's checksum, after reading the values that have changed.

    Returns:
        The names whose values have changed, except for those that move by themselves.

    Raises:
        ChecksumUnavailable: the vehicle computes no checksum now.
        TableDiffers: its table is too different.
        LinkError: the link is closed for good.
    """
    if not await is_free(session.channel):
        raise ChecksumUnavailable(BUSY)
    async with session.channel.ftp:
        try:
            for _ in range(PROOFS_MAX):
                proof = _Proof(session, _rows(session.table))
                await proof.run()
                await proof.confirm()
                changed = proof.take_over()
                if changed is not None:
                    return changed
        except FileTransferError as error:
            if error.code == FileErrorCode.UNKNOWN_COMMAND:
                session.serves_checksum = False
            raise ChecksumUnavailable(f"the checksum was refused: {error.reason}") from None
        except NoReply as error:
            session.ftp_unanswered += error.attempts
            is_silent = session.serves_checksum is None
            raise ChecksumUnavailable("MAVFTP did not answer", is_silent=is_silent) from None
    raise ChecksumUnavailable("the parameters change all the time")


class _Proof:
    """One proof: the file as the vehicle must have it, which is brought in line with its checksums."""

    def __init__(self, session: Session, rows: list[PackedParam]) -> None:
        self._session = session
        self._rows = rows
        self._changed: dict[int, float] = {}  # by index, when the checksum was requested
        self._checksum = 0
        self._round_trip = math.inf  # of the quickest requests
        self._last_time = 0.0  # of the last requests
        self._turn_at = -math.inf

    async def run(self) -> None:
        """Compare, and read what differs.

        Raises:
            TableDiffers: the tables are too different.
        """
        if await self._agrees():
            return
        moving = list(self._moving())
        if len(moving) > MOVING_MAX:
            raise TableDiffers(f"{len(moving)} values of the cached table are not exact")
        whole = range(len(self._rows))
        places = await self._round([whole] if self._round_trip > QUICK_ROUND_TRIP else [], moving)
        if all(at in self._changed for at, row in enumerate(self._rows) if row.name == BOOT_COUNT):
            measured = [at for at, row in enumerate(self._rows) if MEASURED.fullmatch(row.name)]
            places = await self._round([], measured)
        searches = 0
        while not self._is_equal() and self._last_time <= SEARCH_TIME_MAX and searches < SEARCHES_MAX:
            places = await self._round(places or [whole])
            searches += not places
        if self._is_equal() or await self._agrees():
            return
        raise TableDiffers(TOO_MANY)

    def _moving(self) -> Iterator[int]:
        """Return the indices of values that probably are others, or that may be rounded."""
        learnt = self._session.table.volatile
        for at, row in enumerate(self._rows):
            is_learnt = row.name in learnt and not MEASURED.fullmatch(row.name)
            if is_learnt or MOVING.fullmatch(row.name) or may_be_rounded(row):
                yield at

    async def _agrees(self) -> bool:
        """Request the checksum of the whole file, and return whether it is that of the rows."""
        (self._checksum,) = await self._request([None])
        return self._is_equal()

    def _is_equal(self) -> bool:
        return self._checksum == _checksum_of(self._rows)

    async def _round(self, places: list[range], indices: Sequence[int] = ()) -> list[range]:
        """Take over the values at some indices, and ask for the parts of ranges that differ.

        Returns:
            The parts that differ; the value of a part of one parameter is taken over instead.
        """
        if len(places) > PLACES_MAX:
            raise TableDiffers(TOO_MANY)
        began = anyio.current_time()
        single = [range(at, at + 1) for at in indices]
        splits = [self._split(place) for place in places]
        asked = [*single, *(part for parts in splits for part in parts[:-1] or parts)]
        found = dict(zip(asked, await self._request(asked), strict=True))
        for part in single:
            self._solve(part.start, found[part], began)
        remaining = []
        for parts in splits:
            differing = [
                part for part in parts if part in found and found[part] != _checksum_of(self._rows, part)
            ]
            for part in differing or parts[-1:]:  # if no other one does, the last one differs
                if len(part) == 1 and part in found:
                    self._solve(part.start, found[part], began)
                else:
                    remaining.append(part)
        return remaining

    def _split(self, place: range) -> list[range]:
        count = min(1 + max(1, int(self._round_trip / PART_TIME)), PARTS_MAX)
        size = -(-len(place) // count)
        return [place[at : at + size] for at in range(0, len(place), size)]

    def _solve(self, at: int, found: int, requested_at: float) -> None:
        """Take over the one value with which the file of one parameter has this checksum."""
        row, known = self._rows[at], _checksum_of(self._rows, range(at, at + 1))
        difference = crc32_px4_before(found ^ known, row.type.size)
        if difference >> 8 * row.type.size:
            raise TableDiffers(OTHER)
        if difference:
            self._rows[at] = row._replace(bits=row.bits ^ difference)
            self._changed[at] = requested_at

    async def _request(self, places: Sequence[range | None]) -> list[int]:
        """Return the vehicle's checksums of some ranges, or with None, of all."""
        if not places:
            return []
        session, began = self._session, anyio.current_time()
        answers: dict[int, int] = {}
        errors: list[FileTransferError | NoReply] = []
        is_proven = session.serves_checksum or session.serves_file
        attempts = None if is_proven else attempts_unproven(session.channel)

        async def request(number: int, place: range | None) -> None:
            query = "" if place is None else f"?start={place.start}&count={len(place)}"
            try:
                await self._turn()
                answers[number] = await checksum(session.channel, PARAM_FILE + query, attempts=attempts)
            except (FileTransferError, NoReply) as error:
                errors.append(error)
                tasks.cancel_scope.cancel()

        async with anyio.create_task_group() as tasks:
            for number, place in enumerate(places):
                tasks.start_soon(request, number, place)
        if errors:
            raise errors[0]
        session.serves_checksum = True
        self._last_time = anyio.current_time() - began
        self._round_trip = min(self._round_trip, self._last_time)
        return [answers[number] for number in range(len(places))]

    async def _turn(self) -> None:
        """Wait until the vehicle's queue has room for a request."""
        now = anyio.current_time()
        self._turn_at = max(self._turn_at, now - AT_ONCE * INTERVAL) + INTERVAL
        await anyio.sleep(max(self._turn_at - now, 0.0))

    async def confirm(self) -> None:
        """Read the changed values by their indices, and compare names and types.

        Raises:
            TableDiffers: the vehicle has another parameter at such an index.
        """
        other: list[int] = []

        async def read_one(at: int) -> None:
            try:
                found = await read(self._session, at)
            except (NoReply, VehicleError):
                other.append(at)
            else:
                if (found.param_id, found.param_type) != (self._rows[at].name, self._rows[at].type):
                    other.append(at)

        async with anyio.create_task_group() as tasks:
            for at in self._changed:
                tasks.start_soon(read_one, at)
        if other:
            raise TableDiffers(OTHER)

    def take_over(self) -> tuple[str, ...] | None:
        """Put the proven file into the table, and learn which values change.

        Returns:
            The names of the changed values, without those that move by themselves; None where the table has
            changed meanwhile.
        """
        table = self._session.table
        names = [self._rows[at].name for at in self._changed]
        if table.count != len(self._rows):
            return None
        for at, moment in self._changed.items():
            table.store_entry(self._rows[at], at, moment, with_defaults=False)
        if _checksum_of(_rows(table)) != self._checksum:
            return None
        if names:
            table.volatile = frozenset(names)
        table.prove(self._checksum)
        return tuple(each for each in names if not (MOVING.fullmatch(each) or MEASURED.fullmatch(each)))


def _checksum_of(rows: Sequence[PackedParam], place: range | None = None) -> int:
    """Return the checksum of the file with these rows, or of a range of it."""
    part = rows if place is None else rows[place.start : place.stop]
    return crc32_px4(encode(part, total=len(rows), read_size=CHECKED_READ_SIZE))


def _rows(table: Table) -> list[PackedParam]:
    names = [table.names.get(index, "") for index in range(table.count or 0)]
    if not table.params.keys() >= set(names) or len(set(names)) < len(names):
        raise ChecksumUnavailable(
            "the list of parameters has a gap, a name twice, or one that no file can contain"
        )
    return [_row(table, name) for name in names]


def _row(table: Table, name: str) -> PackedParam:
    param = table.params[name]
    if param.is_raw or param.type_number not in PACKABLE:
        raise ChecksumUnavailable(f"the exact value of {name} is not known")
    default = None if param.default is None else bits_of(param.default, param.type_number)
    return PackedParam(name, ParamType(param.type_number), param.bits, default)


def may_be_rounded(row: PackedParam) -> bool:
    """Return whether the integer may stand for others, as a C-cast PARAM_VALUE rounds them to float32."""
    if row.type is not ParamType.INT32 or abs(int(from_bits(row.bits, row.type))) <= FLOAT32_EXACT:
        return False
    bits, _ = bits_of_wire(as_reported(row.bits, row.type, Encoding.C_CAST), row.type, Encoding.C_CAST)
    return bits == row.bits
