"""Who may do what, request by request, in front of an application that would let everyone do everything."""

from __future__ import annotations

import json
import logging
import os
import traceback
from collections.abc import Iterable, MutableMapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import anyio
import pytest

from paramclient.client import signing
from paramclient.errors import UsageError
from paramclient.service import body_limits, body_memory
from paramclient.service.access import AccessMiddleware, AccessSettings, may_write
from paramclient.service.request import SESSION_PATH
from paramclient.service.tokens import (
    SESSION_LIFETIME,
    SESSIONS_OF_HOLDER_MAX,
    WRONG_TOKEN_ADDRESSES_MAX,
    WRONG_TOKEN_DELAY,
    WRONG_TOKEN_LIFETIME,
    WRONG_TOKENS_MAX,
    Sessions,
    TokenHolder,
    Tokens,
    WrongTokens,
    add_token,
    new_token,
    token_line,
    tokens_from,
)
from tests.shell import in_simulated_time, until

ANNA = "anna-may-write-0123456789"
BEN = "ben-may-read-0123456789ab"
TOKENS = Tokens.of_text(f"# who\n\nanna write {ANNA}\n{token_line('ben', 'read', BEN)}\n")
HERE = "127.0.0.1:8765"
OPEN = AccessSettings()
GUARDED = AccessSettings(listen="0.0.0.0", tokens=TOKENS, hosts=["companion.local"])
READ = "/api/v1/components"
WRITE = "/api/v1/components/1/1/apply"


@dataclass
class Answer:
    """The responses."""

    status: int
    headers: dict[str, str]
    body: bytes
    requested: list[Any]

    @property
    def problem(self) -> str:
        assert self.headers["content-type"] == "application/problem+json"
        document = json.loads(self.body)
        assert document["status"] == self.status
        assert document["detail"].endswith(".")
        prefix, kind = document["type"].rsplit(":", 1)
        assert prefix == "urn:paramclient"
        return str(kind)


@dataclass
class Door:
    """The middleware, an application that notes what it gets behind it, and a clock."""

    settings: AccessSettings = OPEN
    now: float = 0.0
    seen: list[Any] = field(default_factory=list)
    headers: list[tuple[bytes, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.middleware = AccessMiddleware(self.app, self.settings, clock=lambda: self.now)

    async def app(self, scope: Any, receive: Any, send: Any) -> None:
        body = b""
        if scope["type"] == "http" and scope["method"] in ("POST", "PUT", "PATCH"):
            message = await receive()
            assert not message["more_body"]
            body = message["body"]
        self.seen.append((scope, body))
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.accept"})
            return
        await send({"type": "http.response.start", "status": 200, "headers": self.headers})
        await send({"type": "http.response.body", "body": body})

    async def request(
        self,
        method: str = "GET",
        path: str = READ,
        *,
        token: str | None = None,
        host: str | None = HERE,
        body: bytes | list[bytes] | None = None,
        kind: str = "application/json",
        pause: float = 0.0,
        raw: Iterable[tuple[bytes, bytes]] = (),
        **scope: Any,
    ) -> Answer:
        """Ask once."""
        headers = list(raw)
        if host is not None:
            headers.append((b"host", host.encode()))
        if token is not None:
            headers.append((b"authorization", f"Bearer {token}".encode()))
        pieces = body if isinstance(body, list) else [] if body is None else [body]
        if body is not None and kind:
            headers.append((b"content-type", kind.encode()))
        if isinstance(body, bytes):
            headers.append((b"content-length", str(len(body)).encode()))
        elif body is not None:
            headers.append((b"transfer-encoding", b"chunked"))
        whole: dict[str, Any] = {
            "type": "http",
            "method": method,
            "path": path,
            "raw_path": quote(path).encode(),
            "query_string": b"",
            "scheme": "http",
            "headers": headers,
            "client": ("10.0.0.2", 50_000),
            "server": ("127.0.0.1", 8765),
        } | scope
        sent: list[MutableMapping[str, Any]] = []
        taken: list[int] = []

        async def receive() -> MutableMapping[str, Any]:
            if whole["type"] == "websocket":
                return {"type": "websocket.connect"}
            number = len(taken)
            taken.append(number)
            await anyio.sleep(pause)
            if number >= len(pieces):
                is_empty = number == 0 and body is None and b"content-length" not in dict(headers)
                nothing = {"type": "http.request", "body": b"", "more_body": False}
                return nothing if is_empty else {"type": "http.disconnect"}
            return {"type": "http.request", "body": pieces[number], "more_body": number + 1 < len(pieces)}

        async def send(message: MutableMapping[str, Any]) -> None:
            sent.append(message)

        await self.middleware(whole, receive, send)
        start = sent[0]
        if start["type"] in ("websocket.accept", "websocket.close"):
            return Answer(101 if start["type"] == "websocket.accept" else 403, {}, b"", taken)
        names = [name for name, _ in start["headers"]]
        assert len(names) - names.count(b"vary") == len(set(names) - {b"vary"}), "a header arrived twice"
        answered = {name.decode(): value.decode() for name, value in start["headers"]}
        return Answer(start["status"], answered, sent[1]["body"], taken)

    @property
    def state(self) -> dict[str, Any]:
        """What the application received about the client."""
        state: dict[str, Any] = self.seen[-1][0]["state"]
        return state


@dataclass
class Asked:
    """A request as routes have it."""

    scope: Any


# Tokens


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "1 to 256 tokens are permitted, not 0"),
        ("anna write", "line 1: a line must have three words"),
        (f"anna admin {ANNA}", "line 1: the second word is the permission"),
        (f"an/na write {ANNA}", "line 1: a name must have 1 to 32 letters"),
        (f"\nanna write {ANNA[:15]}", "line 2: a token must have 16 to 256 printable ASCII characters"),
        (f"anna write {ANNA}\u00e4", "line 1: a token must have 16"),
        ("anna write sha256:12", "line 1: a digest must have 64 hexadecimal digits"),
        (f"anna write {ANNA}\nanna read {BEN}", "two tokens have the same name"),
        (f"anna write {ANNA}\nben read {ANNA}", "two names have the same token"),
        (f"anna write {ANNA}\n{token_line('ben', 'read', ANNA)}", "two names have the same token"),
    ],
)
def test_a_file_that_has_no_tokens_says_where_and_never_what(text: str, words: str) -> None:
    with pytest.raises(UsageError) as caught:
        Tokens.of_text(text)
    assert words in str(caught.value)
    reported = "".join(traceback.format_exception(caught.value))
    assert ANNA[:15] not in reported.replace(__file__, "")


def test_whose_a_token_is() -> None:
    assert TOKENS.holder(ANNA.encode()) == TokenHolder("anna", "write")
    assert TOKENS.holder(BEN.encode()) == TokenHolder("ben", "read")
    for wrong in (b"", ANNA[:-1].encode(), ANNA.upper().encode(), f"{ANNA} ".encode(), b"\xff" * 40):
        assert TOKENS.holder(wrong) is None
    assert repr(TOKENS) == "<Tokens of anna, ben>"
    assert len(TOKENS) == 2


def test_every_token_is_compared_whichever_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[tuple[bytes, bytes]] = []

    def compare(one: bytes, other: bytes) -> bool:
        compared.append((one, other))
        return one == other

    monkeypatch.setattr("hmac.compare_digest", compare)
    for token in (ANNA, BEN, "nobody"):
        compared.clear()
        TOKENS.holder(token.encode())
        assert [len(one) == len(other) == 32 for one, other in compared] == [True, True]


def test_tokens_are_read_from_a_file_or_the_environment(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    token = new_token()
    path.write_text(token_line("anna", "write", token))
    path.chmod(0o600)
    assert token not in path.read_text()
    for tokens in (
        tokens_from(path, {}),
        tokens_from(None, {"PARAMCLIENT_SERVICE_TOKEN_FILE": str(path)}),
    ):
        assert tokens is not None
        assert tokens.holder(token.encode()) == TokenHolder("anna", "write")
    alone = tokens_from(None, {"PARAMCLIENT_SERVICE_TOKEN": token})
    assert alone is not None
    assert alone.holder(token.encode()) == TokenHolder("token", "write")
    assert tokens_from(None, {}) is None
    with pytest.raises(UsageError, match="PARAMCLIENT_SERVICE_TOKEN: a token must have 16"):
        tokens_from(None, {"PARAMCLIENT_SERVICE_TOKEN": "short"})
    both = {"PARAMCLIENT_SERVICE_TOKEN": token, "PARAMCLIENT_SERVICE_TOKEN_FILE": str(path)}
    with pytest.raises(UsageError, match="one of them is enough"):
        tokens_from(None, both)
    with pytest.raises(UsageError, match="nowhere: the file of tokens cannot be read: No such file"):
        tokens_from(tmp_path / "nowhere", {})
    path.write_text("#" * 100_001)
    with pytest.raises(UsageError, match="tokens: a file of tokens may have at most 100000 bytes"):
        tokens_from(path, {})


def test_a_token_is_made_and_kept_as_its_digest(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    anna, ben = add_token(path, "anna", "write"), add_token(path, "ben", "read")
    path.write_text(path.read_text().rstrip("\n"))
    eve = add_token(path, "eve", "write")
    tokens = Tokens.read(path)
    found = [tokens.holder(token.encode()) for token in (anna, ben, eve)]
    assert found == [TokenHolder("anna", "write"), TokenHolder("ben", "read"), TokenHolder("eve", "write")]
    kept = path.read_text()
    assert not any(token in kept for token in (anna, ben, eve))
    assert path.stat().st_mode & 0o777 == 0o600 or os.name != "posix"
    with pytest.raises(UsageError, match="tokens: two tokens have the same name"):
        add_token(path, "anna", "read")
    with pytest.raises(UsageError, match="a name must have 1 to 32 letters"):
        add_token(path, "an na", "read")
    with pytest.raises(UsageError, match="the token cannot be written: Is a directory"):
        add_token(tmp_path, "anna", "read")
    assert path.read_text() == kept


@pytest.mark.skipif(os.name != "posix", reason="there are no such modes")
def test_a_file_of_tokens_is_its_owners_alone(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    path.write_text(f"anna write {ANNA}")
    path.chmod(0o640)
    with pytest.raises(
        UsageError, match=r"other users than its owner can access this file of tokens \(mode 640\)"
    ):
        Tokens.read(path)


@pytest.mark.skipif(os.name != "posix", reason="there are no such owners")
def test_a_file_of_tokens_is_of_this_user_or_root_and_no_link_to_write_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "tokens"
    add_token(path, "anna", "write")
    link = tmp_path / "link"
    link.symlink_to(path)
    assert len(Tokens.read(link)) == 1
    with pytest.raises(UsageError, match="link: the file is a symbolic link"):
        add_token(link, "bob", "read")
    assert len(Tokens.read(path)) == 1
    monkeypatch.setattr(signing, "has_trusted_owner", lambda status: False)
    with pytest.raises(UsageError, match="this file of tokens belongs to another user"):
        Tokens.read(path)
    with pytest.raises(UsageError, match="this file of tokens belongs to another user"):
        add_token(path, "bob", "read")


@pytest.mark.skipif(os.name != "posix", reason="there are no such modes")
def test_a_credential_of_systemd_may_look_as_if_a_group_could_read_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    path = tmp_path / "tokens"
    path.write_text(f"anna write {ANNA}")
    path.chmod(0o440)
    assert tokens_from(path, {}) is not None
    path.chmod(0o444)
    with pytest.raises(UsageError, match="other users than its owner"):
        tokens_from(path, {})
    (tmp_path / "further").mkdir()
    elsewhere = tmp_path / "further" / "tokens"
    elsewhere.write_text(f"anna write {ANNA}")
    elsewhere.chmod(0o440)
    with pytest.raises(UsageError, match="other users than its owner"):
        tokens_from(elsewhere, {})


def test_tokens_that_are_made_differ_and_are_long() -> None:
    made = {new_token() for _ in range(100)}
    assert len(made) == 100
    assert min(map(len, made)) >= 43


# Where it listens


@pytest.mark.parametrize("listen", ["127.0.0.1", "127.3.2.1", "::1", "localhost"])
def test_on_this_machine_alone_no_token_is_needed(listen: str) -> None:
    assert AccessSettings(listen=listen).tokens is None


@pytest.mark.parametrize(
    "options",
    [
        *({"listen": "0.0.0.0"}, {"listen": "::"}, {"listen": "10.0.0.1"}, {"listen": "companion"}),
        *({"listen": ""}, {"hosts": ["companion.local"]}, {"listen": "0.0.0.0", "read_only": True}),
    ],
)
def test_beyond_this_machine_it_does_not_start_without_a_token(options: dict[str, Any]) -> None:
    with pytest.raises(
        UsageError, match=r"needs a token. Create one with `paramclient token NAME --file FILE`"
    ):
        AccessSettings(**options)
    assert AccessSettings(**options, tokens=TOKENS).tokens is TOKENS


def test_hosts_are_the_same_when_they_are_taken_over() -> None:
    settings = AccessSettings(hosts=["Companion.Local.", "[2001:DB8::1]", "10.0.0.1"], tokens=TOKENS)
    assert settings.hosts == {"companion.local", "2001:db8::1", "10.0.0.1"}
    assert replace(settings, listen="0.0.0.0").hosts == settings.hosts


@pytest.mark.parametrize("origin", ["*", "null", "station.example", "https://a/b", "https://*", "file://x"])
def test_origins_are_named_one_by_one(origin: str) -> None:
    with pytest.raises(UsageError, match="is not an origin"):
        AccessSettings(origins=[origin])


@pytest.mark.parametrize("host", ["*", "a b", "companion.local:80", "", "http://x", "a/b"])
def test_hosts_are_named_one_by_one(host: str) -> None:
    with pytest.raises(UsageError, match="is not a host name"):
        AccessSettings(hosts=[host], tokens=TOKENS)


# Who asks


@in_simulated_time
async def test_without_tokens_every_client_on_this_machine_may_write() -> None:
    door = Door()
    assert (await door.request("POST", WRITE, body=b"{}")).status == 200
    local = {"author": "local", "name": "local", "role": "write", "read_only": False}
    assert door.state == {**local, "quota": "the address 10.0.0.2"}
    assert may_write(Asked(door.seen[-1][0]))
    await door.request(raw=[(b"x-author", b"calibrate.py")])
    assert door.state["author"] == "local (calibrate.py)"


@in_simulated_time
async def test_with_tokens_a_request_without_a_token_is_refused() -> None:
    door = Door(GUARDED)
    public = ["/", "/health", "/page/app.js", "/favicon.ico"]
    for path in public:
        assert (await door.request(path=path)).status == 200
        assert door.state["role"] is None
        assert not may_write(Asked(door.seen[-1][0]))
    door.seen.clear()
    for path in (
        READ,
        "/metrics",
        "/openapi.json",
        "/docs",
        "/api/v1/me",
        "/api/v1/events",
        "/page",
        "/healthy",
    ):
        answer = await door.request(path=path)
        assert (answer.status, answer.problem) == (401, "unauthenticated")
        assert answer.headers["www-authenticate"].startswith("Bearer")
    for method in ("POST", "PUT", "PATCH", "DELETE", "TRACE", "OPTIONS"):
        for path in (READ, "/", "/page/app.js", "/health"):
            assert (await door.request(method, path)).status == 401, (method, path)
    assert not door.seen


@in_simulated_time
async def test_a_token_identifies_the_author_and_is_not_passed_on() -> None:
    door = Door(GUARDED)
    cookie = (b"cookie", b"other=1; paramclient-8765=nonsense")
    assert (await door.request(token=ANNA, raw=[(b"x-author", b"web page"), cookie])).status == 200
    assert door.state == {
        "author": "anna@10.0.0.2 (web page)",
        "name": "anna",
        "role": "write",
        "read_only": False,
        "quota": "the token anna",
    }
    assert (await door.request(token=BEN, client=("::ffff:10.0.0.9", 1))).status == 200
    assert (door.state["author"], door.state["role"]) == ("ben@10.0.0.9", "read")
    assert (await door.request(token=BEN, client=("fe80::1%eth0", 1))).status == 200
    assert door.state["author"] == "ben@fe80::1"
    for scope, _ in door.seen:
        assert not {b"authorization", b"cookie"} & {name for name, _ in scope["headers"]}
        assert ANNA not in repr(scope)
        assert BEN not in repr(scope)
    for wrong in (b"a\nb", b"\xe4", b"", b"x" * 65):
        assert (await door.request(token=ANNA, raw=[(b"x-author", wrong)])).problem == "bad-request"


@in_simulated_time
async def test_an_author_has_at_most_128_characters() -> None:
    text = f"{'n' * 32} write {ANNA}"
    door = Door(AccessSettings(tokens=Tokens.of_text(text)))
    address = "2001:0db8:85a3:1111:2222:8a2e:3370:7334"
    await door.request(token=ANNA, client=(address, 1), raw=[(b"x-author", b"x" * 64)])
    assert len(door.state["author"]) == 128
    assert door.state["author"].startswith(f"{'n' * 32}@2001:db8:85a3:1111:2222:8a2e:3370:7334 (xxx")


@pytest.mark.parametrize("given", ["Basic YTpi", "Bearer", "Bearer  ", "Token x", BEN])
@in_simulated_time
async def test_malformed_authorization_is_refused(given: str) -> None:
    door = Door(GUARDED)
    assert (await door.request(raw=[(b"authorization", given.encode())])).status == 401
    assert not door.seen


READS = [
    *(("GET", READ), ("HEAD", READ), ("POST", "/api/v1/components/1/1/fetch")),
    *(("POST", "/api/v1/components/1/1/params/apply/read"), ("POST", "/api/v1/components/1/1/plan")),
    ("POST", "/api/v1/components/1/1/restore/plan"),
    *(("POST", "/api/v1/components/1/1/diff"), ("POST", "/api/v1/files"), ("DELETE", "/api/v1/jobs/7")),
]
WRITES = [
    *(
        ("POST", WRITE),
        ("POST", "/api/v1/components/1/1/reboot"),
        ("POST", "/api/v1/components/1/1/restore"),
        ("POST", "/api/v1/what-comes-later"),
    ),
    *(("PUT", "/api/v1/components/1/1/params/fetch"), ("PATCH", "/api/v1/components/1/1/params")),
    *(("DELETE", "/api/v1/components"), ("POST", "/api/v1/components/1/1/fetch/"), ("LOCK", "/x/read")),
]


@pytest.mark.parametrize(("method", "path"), READS)
@in_simulated_time
async def test_those_who_read_may_ask_for_everything(method: str, path: str) -> None:
    for settings in (GUARDED, AccessSettings(tokens=TOKENS, read_only=True)):
        assert (await Door(settings).request(method, path, token=BEN)).status == 200


@pytest.mark.parametrize(("method", "path"), WRITES)
@in_simulated_time
async def test_changes_need_a_token_that_may_write(method: str, path: str) -> None:
    door = Door(GUARDED)
    assert (await door.request(method, path, token=BEN)).problem == "forbidden"
    assert not door.seen
    assert (await door.request(method, path, token=ANNA)).status == 200
    door = Door(AccessSettings(tokens=TOKENS, read_only=True))
    assert (await door.request(method, path, token=ANNA)).problem == "read-only"
    assert (await Door(AccessSettings(read_only=True)).request(method, path)).problem == "read-only"
    assert not door.seen
    assert (await door.request(token=ANNA)).status == 200
    assert not may_write(Asked(door.seen[-1][0]))


# Sessions of browsers


def cookie_of(answer: Answer) -> tuple[bytes, bytes]:
    return (b"cookie", answer.headers["set-cookie"].partition(";")[0].encode())


@in_simulated_time
async def test_a_browser_shows_its_token_once() -> None:
    door = Door(GUARDED)
    begun = await door.request("POST", SESSION_PATH, body=json.dumps({"token": BEN}).encode())
    assert (begun.status, json.loads(begun.body)) == (
        200,
        {"role": "read", "name": "ben", "read_only": False},
    )
    name, *rest = begun.headers["set-cookie"].split("; ")
    assert name.startswith("paramclient-8765=")
    assert len(name.partition("=")[2]) >= 43
    assert rest == ["Path=/", f"Max-Age={SESSION_LIFETIME:.0f}", "HttpOnly", "SameSite=Strict"]
    assert BEN not in begun.headers["set-cookie"]
    cookie = cookie_of(begun)
    assert (await door.request(raw=[cookie])).status == 200
    assert door.state["author"] == "ben@10.0.0.2"
    assert (await door.request("POST", WRITE, raw=[cookie])).problem == "forbidden"
    door.now = SESSION_LIFETIME
    assert (await door.request(raw=[cookie])).problem == "unauthenticated"
    assert (await door.request(path="/", raw=[cookie])).status == 200, "or no client could send another token"


@in_simulated_time
async def test_a_session_ends_when_the_browser_says_so() -> None:
    door = Door(GUARDED)
    body = json.dumps({"token": ANNA}).encode()
    begun = [await door.request("POST", SESSION_PATH, body=body) for _ in range(2)]
    ended = await door.request("DELETE", SESSION_PATH, raw=[cookie_of(begun[0])])
    assert ended.status == 204
    assert "Max-Age=0" in ended.headers["set-cookie"]
    assert (await door.request(raw=[cookie_of(begun[0])])).status == 401
    assert (await door.request(raw=[cookie_of(begun[1])])).status == 200


@in_simulated_time
async def test_under_tls_the_cookie_goes_nowhere_else() -> None:
    door = Door(GUARDED)
    body = json.dumps({"token": ANNA}).encode()
    begun = await door.request("POST", SESSION_PATH, body=body, scheme="https")
    assert begun.headers["set-cookie"].endswith("; HttpOnly; SameSite=Strict; Secure")


@pytest.mark.parametrize(
    ("body", "kind", "problem"),
    [
        (b"{}", "application/json", "invalid-request"),
        (b"[" * 1000, "application/json", "invalid-request"),
        (b'{"token": 1}', "application/json", "invalid-request"),
        (b'{"token": "\\ud800"}', "application/json", "unauthenticated"),
        (b'{"token": "wrong"}', "application/json", "unauthenticated"),
        (b"token=" + ANNA.encode(), "application/x-www-form-urlencoded", "content-type"),
        (b'{"token": "%s"}' % ANNA.encode(), "text/plain", "content-type"),
        (b'{"token": "%s"}' % (b"x" * 2000), "application/json", "too-large"),
        (None, "", "content-type"),
    ],
)
@in_simulated_time
async def test_no_session_begins_without_a_token(body: bytes | None, kind: str, problem: str) -> None:
    door = Door(GUARDED)
    answer = await door.request("POST", SESSION_PATH, body=body, kind=kind)
    assert answer.problem == problem
    assert "set-cookie" not in answer.headers


@in_simulated_time
async def test_a_session_without_tokens_sets_no_cookie() -> None:
    answer = await Door().request("POST", SESSION_PATH, body=b'{"token": "any"}')
    assert json.loads(answer.body) == {"role": "write", "name": "local", "read_only": False}
    assert "set-cookie" not in answer.headers


def test_sessions_are_few() -> None:
    now = 0.0
    sessions = Sessions(lambda: now)
    anna, ben = TokenHolder("anna", "write"), TokenHolder("ben", "read")
    kept = sessions.begin(ben)
    texts = [sessions.begin(anna) for _ in range(3 * SESSIONS_OF_HOLDER_MAX)]
    assert len(sessions) == SESSIONS_OF_HOLDER_MAX + 1
    assert sessions.holder(kept.encode()) == ben
    assert sessions.holder(texts[-1].encode()) == anna
    assert sessions.holder(texts[0].encode()) is None
    now = SESSION_LIFETIME
    sessions.begin(ben)
    assert len(sessions) == 1


# Guessing


@in_simulated_time
async def test_guesses_are_answered_late_and_a_right_token_is_not_refused(
    caplog: pytest.LogCaptureFixture,
) -> None:
    door = Door(GUARDED)
    requested = anyio.current_time()
    with caplog.at_level(logging.DEBUG):
        for number in range(WRONG_TOKENS_MAX):
            assert (await door.request(token=f"wrong-{number}")).status == 401
        assert round(anyio.current_time() - requested, 3) == 0
        for number in range(3):
            late = await door.request(token=f"wrong-too-{number}")
            assert (late.status, late.problem) == (429, "too-many-guesses")
            assert late.headers["retry-after"] == str(int(WRONG_TOKEN_LIFETIME))
            assert round(anyio.current_time() - requested, 3) == (number + 1) * WRONG_TOKEN_DELAY
    assert [record.getMessage() for record in caplog.records] == ["many wrong tokens from 10.0.0.2"]
    requested = anyio.current_time()
    assert (await door.request(token=ANNA)).status == 200, "others may be behind the same proxy"
    body = json.dumps({"token": ANNA}).encode()
    assert (await door.request("POST", SESSION_PATH, body=body)).status == 200
    assert round(anyio.current_time() - requested, 3) == 2 * WRONG_TOKEN_DELAY, (
        "else the response time distinguishes a right token from a wrong one"
    )
    requested = anyio.current_time()
    assert (await door.request(token=ANNA, client=("10.0.0.3", 1))).status == 200
    assert (await door.request(path="/")).status == 200
    door.now = WRONG_TOKEN_LIFETIME
    assert (await door.request(token=ANNA)).status == 200
    assert round(anyio.current_time() - requested, 3) == 0, "no other client waits, and none a minute later"


PROXY = AccessSettings(listen="0.0.0.0", tokens=TOKENS, proxies=["10.0.0.2", "192.0.2.0/24", "2001:db8::/32"])


@pytest.mark.parametrize(
    ("raw", "client"),
    [
        ([], "10.0.0.2"),
        ([("x-forwarded-for", "198.51.100.7")], "198.51.100.7"),
        ([("x-forwarded-for", "1.2.3.4, 198.51.100.7")], "198.51.100.7"),
        ([("x-forwarded-for", "1.2.3.4"), ("x-forwarded-for", "198.51.100.7, 192.0.2.9")], "198.51.100.7"),
        ([("x-forwarded-for", "198.51.100.7:50123")], "198.51.100.7"),
        ([("x-forwarded-for", "[2001:db9::7]:50123, 2001:db8::1")], "2001:db9::7"),
        ([("x-forwarded-for", "::ffff:198.51.100.7")], "198.51.100.7"),
        ([("x-forwarded-for", "192.0.2.1, 192.0.2.2")], "192.0.2.1"),
        ([("x-forwarded-for", "198.51.100.7, unknown, 192.0.2.2")], "192.0.2.2"),
        ([("x-forwarded-for", "")], "10.0.0.2"),
        ([("forwarded", "for=1.2.3.4, for=198.51.100.7;proto=https")], "198.51.100.7"),
        ([("forwarded", 'proto=https; FOR="[2001:db9::7]:4711"')], "2001:db9::7"),
        ([("forwarded", 'for="1.2.3.4, for=198.51.100.7')], "198.51.100.7"),
        ([("forwarded", "for=_hidden")], "10.0.0.2"),
        ([("forwarded", "for=198.51.100.7"), ("x-forwarded-for", "198.51.100.7")], "198.51.100.7"),
    ],
)
@in_simulated_time
async def test_a_trusted_proxy_names_the_client(raw: list[tuple[str, str]], client: str) -> None:
    door = Door(PROXY)
    headers = [(name.encode(), value.encode()) for name, value in raw]
    assert (await door.request(token=ANNA, raw=headers)).status == 200
    assert door.state["author"] == f"anna@{client}"


@in_simulated_time
async def test_forwarded_headers_count_only_from_trusted_proxies() -> None:
    reported = [(b"x-forwarded-for", b"198.51.100.7"), (b"forwarded", b"for=198.51.100.8")]
    door = Door(PROXY)
    assert (await door.request(token=ANNA, raw=reported, client=("10.0.0.3", 1))).status == 200
    assert door.state["author"] == "anna@10.0.0.3"
    assert (await door.request(token=ANNA, raw=reported)).problem == "bad-request", (
        "one of the two is not the proxy's"
    )
    door = Door(GUARDED)
    assert (await door.request(token=ANNA, raw=reported)).status == 200
    assert door.state["author"] == "anna@10.0.0.2"


@in_simulated_time
async def test_guesses_slow_down_one_client_of_a_proxy_that_is_trusted() -> None:
    door = Door(PROXY)
    for number in range(2 * WRONG_TOKENS_MAX):
        await door.request(token=f"wrong-{number}", raw=[(b"x-forwarded-for", b"198.51.100.7")])
    requested = anyio.current_time()
    assert (await door.request(token=ANNA, raw=[(b"x-forwarded-for", b"198.51.100.8")])).status == 200
    assert round(anyio.current_time() - requested, 3) == 0
    assert (await door.request(token=ANNA, raw=[(b"x-forwarded-for", b"198.51.100.7")])).status == 200
    assert round(anyio.current_time() - requested, 3) == WRONG_TOKEN_DELAY


@pytest.mark.parametrize("proxy", ["proxy.example", "10.0.0.1/8", "10.0.0.0/33", ""])
def test_proxies_are_addresses_and_networks(proxy: str) -> None:
    with pytest.raises(UsageError, match="is not an address or a network such as"):
        AccessSettings(tokens=TOKENS, proxies=[proxy])


def test_behind_a_proxy_it_does_not_start_without_a_token() -> None:
    with pytest.raises(UsageError, match=r"behind a proxy, .* needs a token"):
        AccessSettings(proxies=["127.0.0.1"])


@in_simulated_time
async def test_a_program_with_an_old_token_delays_no_other_client() -> None:
    door = Door(GUARDED)
    requested = anyio.current_time()
    for _ in range(10 * WRONG_TOKENS_MAX):
        assert (await door.request(token="an-old-token-of-somebody")).status == 401
    assert (await door.request(token=ANNA)).status == 200
    assert round(anyio.current_time() - requested, 3) == 0


def test_those_who_guess_are_remembered_in_bounds() -> None:
    guesses = WrongTokens(lambda: 0.0)
    for number in range(WRONG_TOKENS_MAX):
        guesses.add(f"2001:db8::{number:x}", f"wrong-{number}".encode())
    assert guesses.wait("2001:db8::ffff") == WRONG_TOKEN_LIFETIME, "one machine has many such addresses"
    assert guesses.wait("2001:db8:0:1::1") == 0
    for number in range(2 * WRONG_TOKEN_ADDRESSES_MAX):
        for token in range(3 * WRONG_TOKENS_MAX):
            guesses.add(f"10.0.{number >> 8}.{number & 255}", str(token).encode())
    assert len(guesses) == WRONG_TOKEN_ADDRESSES_MAX
    assert max(map(len, guesses._wrong.values())) == WRONG_TOKENS_MAX


# By which name it is called


@pytest.mark.parametrize("host", [HERE, "localhost", "LOCALHOST:1", "localhost.", "[::1]:8765", "127.9.9.9"])
@in_simulated_time
async def test_loopback_host_names_are_accepted(host: str) -> None:
    for settings in (OPEN, GUARDED):
        assert (await Door(settings).request(host=host, token=ANNA)).status == 200


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:8765",
        "localhost.evil.example",
        "127.0.0.1.evil.example",
        "127-0-0-1.local",
    ],
)
@in_simulated_time
async def test_a_name_that_is_not_its_own_is_refused(host: str) -> None:
    """DNS rebinding: the name of a foreign page may resolve to this service, with the same origin."""
    for settings in (OPEN, GUARDED):
        door = Door(settings)
        for path in (READ, "/", "/health"):
            answer = await door.request(
                path=path, host=host, token=ANNA, raw=[(b"origin", f"http://{host}".encode())]
            )
            assert (answer.status, answer.problem) == (421, "foreign-host")
        assert not door.seen


@in_simulated_time
async def test_addresses_are_names_of_one_that_listens_beyond_this_machine() -> None:
    for host in ("10.0.0.1:8765", "[2001:db8::1]", "companion.local", "Companion.Local:80"):
        assert (await Door(GUARDED).request(host=host, token=ANNA)).status == 200
        assert (await Door(OPEN).request(host=host)).problem == "foreign-host"
    door = Door(AccessSettings(listen="station-7", tokens=TOKENS))
    assert (await door.request(host="station-7:8765", token=ANNA)).status == 200


@pytest.mark.parametrize(
    "host", [None, "", "user@localhost", "localhost:", "localhost:x", "[::1", "local host", "localhost/x"]
)
@in_simulated_time
async def test_a_host_that_is_none_is_refused(host: str | None) -> None:
    assert (await Door().request(host=host)).problem == "bad-request"


# From which page


BROWSER_READS = [(b"sec-fetch-mode", b"cors"), (b"sec-fetch-dest", b"empty")]


@in_simulated_time
async def test_the_page_of_the_service_may_do_everything() -> None:
    door = Door()
    own = [(b"origin", b"http://127.0.0.1:8765"), (b"sec-fetch-site", b"same-origin"), *BROWSER_READS]
    assert (await door.request("POST", WRITE, body=b"{}", raw=own)).status == 200
    secure = [(b"origin", b"https://127.0.0.1:8765")]
    assert (await door.request("POST", WRITE, body=b"{}", raw=secure, scheme="https")).status == 200
    assert (await door.request("POST", WRITE, body=b"{}", raw=secure)).problem == "foreign-origin"
    typed = [(b"sec-fetch-site", b"none"), (b"sec-fetch-mode", b"navigate"), (b"sec-fetch-dest", b"document")]
    assert (await door.request(path="/", raw=typed)).status == 200


@pytest.mark.parametrize(
    "origin",
    [
        *(
            "http://evil.example",
            "null",
            "http://127.0.0.1",
            "http://127.0.0.1:8766",
            "http://localhost:8765",
        ),
        *("http://127.0.0.1:8765.evil.example", "", "http://127.0.0.1:8765/"),
    ],
)
@in_simulated_time
async def test_pages_from_elsewhere_may_do_nothing(origin: str) -> None:
    door = Door()
    for method in ("GET", "POST", "OPTIONS", "DELETE"):
        for more in ([], [(b"access-control-request-method", b"PUT")]):
            answer = await door.request(method, raw=[(b"origin", origin.encode()), *more])
            assert (answer.status, answer.problem) == (403, "foreign-origin")
            assert not [name for name in answer.headers if name.startswith("access-control")]
    assert not door.seen


@pytest.mark.parametrize("site", ["cross-site", "same-site", "anything"])
@in_simulated_time
async def test_a_page_from_elsewhere_may_lead_here_and_no_more(site: str) -> None:
    door = Door()
    fetched = [(b"sec-fetch-site", site.encode())]
    assert (await door.request(raw=fetched)).problem == "foreign-origin"
    assert (await door.request(raw=[*fetched, *BROWSER_READS])).problem == "foreign-origin"
    navigated = [*fetched, (b"sec-fetch-mode", b"navigate")]
    assert (await door.request(raw=[*navigated, (b"sec-fetch-dest", b"iframe")])).problem == "foreign-origin"
    followed = [*navigated, (b"sec-fetch-dest", b"document")]
    assert (await door.request("POST", WRITE, raw=followed)).problem == "foreign-origin"
    assert (await door.request(path="/", raw=followed)).status == 200


@in_simulated_time
async def test_a_page_that_is_named_may_use_it_from_elsewhere() -> None:
    settings = AccessSettings(tokens=TOKENS, origins=["https://Station.example:8443"])
    door = Door(settings)
    origin = (b"origin", b"https://station.example:8443")
    foreign = [origin, (b"sec-fetch-site", b"cross-site"), *BROWSER_READS]
    requested = await door.request(
        "OPTIONS", WRITE, raw=[*foreign, (b"access-control-request-method", b"POST")]
    )
    assert requested.status == 204
    assert requested.headers["access-control-allow-origin"] == "https://station.example:8443"
    assert "authorization" in requested.headers["access-control-allow-headers"].lower()
    assert {"PUT", "PATCH", "DELETE"} <= set(requested.headers["access-control-allow-methods"].split(", "))
    assert "access-control-allow-credentials" not in requested.headers
    assert not door.seen
    answer = await door.request("POST", WRITE, token=ANNA, body=b"{}", raw=foreign)
    assert (answer.status, answer.headers["vary"]) == (200, "Origin")
    assert answer.headers["access-control-allow-origin"] == "https://station.example:8443"
    assert "X-Seq" in answer.headers["access-control-expose-headers"]
    refused = await door.request("POST", WRITE, body=b"{}", raw=foreign)
    assert refused.problem == "unauthenticated"
    assert refused.headers["access-control-allow-origin"] == "https://station.example:8443", "it may read why"
    other = await door.request(token=ANNA)
    assert other.headers["vary"] == "Origin"
    assert "access-control-allow-origin" not in other.headers
    assert (await door.request(raw=[(b"origin", b"https://other.example")])).problem == "foreign-origin"


@in_simulated_time
async def test_without_tokens_a_page_that_is_named_may_read_only() -> None:
    """A page in the browser of a local user, who may do everything."""
    door = Door(AccessSettings(origins=["https://station.example"]))
    foreign = [(b"origin", b"https://station.example"), (b"sec-fetch-site", b"cross-site"), *BROWSER_READS]
    assert (await door.request(raw=foreign)).status == 200
    assert door.state["role"] == "read"
    assert not may_write(Asked(door.seen[-1][0]))
    seen = len(door.seen)
    for method in ("POST", "PUT", "PATCH", "DELETE"):
        body = None if method == "DELETE" else b"{}"
        refused = await door.request(method, WRITE, body=body, raw=foreign)
        assert (refused.status, refused.problem) == (403, "forbidden")
        assert b"Without tokens" in refused.body
        assert refused.headers["access-control-allow-origin"] == "https://station.example", "it may read why"
    assert len(door.seen) == seen
    own = [(b"origin", b"http://127.0.0.1:8765")]
    assert (await door.request("POST", WRITE, body=b"{}", raw=own)).status == 200


@pytest.mark.parametrize(
    "kind", ["", "text/plain", "application/x-www-form-urlencoded", "multipart/form-data"]
)
@in_simulated_time
async def test_a_body_is_of_a_kind_that_no_form_can_send(kind: str) -> None:
    door = Door()
    answer = await door.request("POST", WRITE, body=b"{}", kind=kind)
    assert (answer.status, answer.problem) == (415, "content-type")
    assert answer.headers["connection"] == "close"
    assert not answer.requested
    assert not door.seen
    assert (
        await door.request("POST", WRITE, body=b"{}", kind="Application/JSON; charset=utf-8")
    ).status == 200
    assert (
        await door.request("POST", "/api/v1/files", body=b"x", kind="application/octet-stream")
    ).status == 200


# WebSocket


def handshake(door: Door, **options: Any) -> Any:
    return door.request(
        path="/api/v1/ws",
        type="websocket",
        scheme="ws",
        extensions={"websocket.http.response": {}},
        **options,
    )


@in_simulated_time
async def test_a_websocket_is_let_in_like_everything_else() -> None:
    door = Door(GUARDED)
    assert (await handshake(door, token=BEN)).status == 101
    assert door.state["author"] == "ben@10.0.0.2"
    own = (b"origin", b"http://127.0.0.1:8765")
    assert (await handshake(door, token=BEN, raw=[own])).status == 101
    door.seen.clear()
    assert (await handshake(door)).problem == "unauthenticated"
    assert (await handshake(door, token="wrong")).problem == "unauthenticated"
    assert (await handshake(door, token=BEN, host="evil.example")).problem == "foreign-host"
    foreign = (b"origin", b"http://evil.example")
    assert (await handshake(door, token=BEN, raw=[foreign])).problem == "foreign-origin"
    assert (
        await handshake(door, token=BEN, raw=[(b"sec-fetch-site", b"cross-site")])
    ).problem == "foreign-origin"
    assert (await handshake(Door(), raw=[foreign])).problem == "foreign-origin"
    plain = await door.request(path="/api/v1/ws", type="websocket", scheme="ws")
    assert plain.status == 403, "where the server cannot say why"
    assert not door.seen


# What means two things


@pytest.mark.parametrize(
    "path",
    [
        *("/page/../x", "/page/..", "/./health", "//health", "/page//x", "/api/v1/components//1", "*", ""),
        *(
            "http://evil.example/health",
            "health",
            "/page/\x00",
            "/page/a\nb",
            "/page\\..\\x",
            "/\x7f",
            "/\ufffd",
        ),
    ],
)
@in_simulated_time
async def test_a_path_is_plain(path: str) -> None:
    door = Door()
    assert (await door.request(path=path)).problem == "bad-path"
    assert not door.seen


@in_simulated_time
async def test_a_slash_in_a_name_is_a_part_of_it() -> None:
    door = Door()
    for path, raw in (
        (
            "/api/v1/vehicles/system:1@serial:/dev//tty/../ttyS1/1/params",
            b"/api/v1/vehicles/system%3A1%40x%2F%2Fy/1",
        ),
        ("/x/..", b"/x%2F.."),
    ):
        assert (await door.request(path=path, raw_path=raw)).status == 200
    for raw in (b"/x/%2e%2E/y", b"/x/.%2e", b"/%2e/x", b"/x//y", b"x"):
        assert (await door.request(path="/x/y", raw_path=raw)).problem == "bad-path"


@pytest.mark.parametrize(
    "raw",
    [
        [(b"host", b"evil.example")],
        [(b"Host", HERE.encode())],
        [(b"content-length", b"1"), (b"transfer-encoding", b"chunked")],
        [(b"content-length", b"1"), (b"content-length", b"2")],
        [(b"content-length", b"-1")],
        [(b"content-length", b"1_0")],
        [(b"content-length", b"9" * 5000)],
        [(b"content-length", "\u0661".encode())],
        [(b"transfer-encoding", b"chunked"), (b"transfer-encoding", b"identity")],
        [(b"content-type", b"application/json"), (b"content-type", b"text/plain")],
        [(b"origin", b"http://127.0.0.1:8765"), (b"origin", b"http://evil.example")],
        [(b"authorization", b"Bearer x"), (b"authorization", b"Bearer y")],
        [(b"x-author", b"x"), (b"x-author", b"y")],
    ],
)
@in_simulated_time
async def test_a_header_that_counts_arrives_once(raw: list[tuple[bytes, bytes]]) -> None:
    for settings in (OPEN, GUARDED):
        door = Door(settings)
        token = None if raw[0][0] == b"authorization" else ANNA
        answer = await door.request("POST", WRITE, raw=raw, token=token)
        assert (answer.status, answer.problem) == (400, "bad-request")
        assert not door.seen


@in_simulated_time
async def test_requests_are_short() -> None:
    door = Door()
    many = [(b"x-%d" % number, b"") for number in range(70)]
    assert (await door.request(raw=many)).problem == "headers-too-large"
    assert (await door.request(raw=[(b"x", b"x" * 20_000)])).problem == "headers-too-large"
    assert (await door.request(query_string=b"x" * 9_000)).problem == "address-too-long"
    assert (await door.request(path="/" + "x" * 9_000)).problem == "address-too-long"
    assert not door.seen


# Bodies


SMALL = AccessSettings(max_body=100)


@in_simulated_time
async def test_a_body_arrives_in_one_piece() -> None:
    door = Door(SMALL)
    answer = await door.request("POST", WRITE, body=[b"12", b"", b"3" * 98])
    assert answer.body == b"12" + b"3" * 98
    assert (await door.request("POST", WRITE, body=b"x" * 100)).status == 200


@in_simulated_time
async def test_a_body_that_is_too_long_is_not_waited_for() -> None:
    door = Door(SMALL)
    said = await door.request("POST", WRITE, body=b"x" * 101)
    assert (said.status, said.problem, said.requested) == (413, "too-large", [])
    endless = await door.request("POST", WRITE, body=[b"x" * 40] * 1_000)
    assert (endless.status, endless.problem, len(endless.requested)) == (413, "too-large", 3)
    assert said.headers["connection"] == endless.headers["connection"] == "close"
    assert not door.seen
    assert (await door.request("POST", WRITE, body=b"x" * 100)).status == 200


@in_simulated_time
async def test_a_body_that_takes_for_ever_is_not_waited_for() -> None:
    door = Door(SMALL)
    slow = await door.request("POST", WRITE, body=[b"x"] * 90, pause=1.0)
    assert (slow.status, slow.problem) == (408, "too-slow")
    gone = await door.request("POST", WRITE, raw=[(b"content-length", b"10"), _JSON])
    assert gone.problem == "bad-request"
    assert not door.seen


@in_simulated_time
async def test_bodies_are_not_many_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_memory, "TOTAL_BODY_BYTES_MAX", 250)
    door = Door(SMALL)
    statuses: list[int] = []

    async def ask() -> None:
        statuses.append((await door.request("POST", WRITE, body=[b"x" * 90, b""], pause=1.0)).status)

    async with anyio.create_task_group() as tasks:
        for _ in range(5):
            tasks.start_soon(ask)
    assert sorted(statuses) == [200, 200, 503, 503, 503]
    assert (await door.request("POST", WRITE, body=b"x" * 90)).status == 200, "and then there is room again"


@dataclass
class Pending(Door):
    """An application that has read its body, and responds on demand."""

    go_on: anyio.Event = field(default_factory=anyio.Event)

    async def app(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["path"] == WRITE:
            await self.go_on.wait()
        await super().app(scope, receive, send)


@in_simulated_time
async def test_bodies_count_until_their_requests_are_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_memory, "TOTAL_BODY_BYTES_MAX", 250)
    door = Pending(SMALL)
    statuses: list[int] = []

    async def ask() -> None:
        statuses.append((await door.request("POST", WRITE, body=b"x" * 90)).status)

    async with anyio.create_task_group() as tasks:
        for _ in range(3):
            tasks.start_soon(ask)
        await until(lambda: statuses)
        assert statuses == [503], "two are read, and wait for their answer"
        door.go_on.set()
    assert sorted(statuses) == [200, 200, 503]
    assert (await door.request("POST", WRITE, body=b"x" * 90)).status == 200, "and then there is room again"


@in_simulated_time
async def test_one_holder_takes_no_room_from_others() -> None:
    """Sixty bodies of a megabyte, none of them whole: as many are read as fit into the quota of one."""
    door = Door(GUARDED)
    megabyte = b" " * (1 << 20)
    answers: list[Answer] = []

    async def ask() -> None:
        body = [megabyte, *[b" "] * 50]
        answers.append(await door.request("POST", WRITE, body=body, pause=1.0, token=ANNA))

    async with anyio.create_task_group() as tasks:
        for _ in range(60):
            tasks.start_soon(ask)
        await until(lambda: len(answers) == 45)
        assert {answer.problem for answer in answers} == {"too-many"}
        assert {answer.status for answer in answers} == {429}
        assert str(body_limits.HOLDER_BODY_BYTES_MAX).encode() in answers[0].body
        assert answers[0].headers["retry-after"] == "1"
        others = await door.request("POST", "/api/v1/components/1/1/diff", body=megabyte, token=BEN)
        assert others.status == 200
        assert (await door.request("POST", WRITE, body=megabyte, token=ANNA)).problem == "too-many"
    assert [answer.status for answer in answers].count(200) == 15


@pytest.mark.parametrize(
    ("first", "second", "statuses"),
    [
        ("10.0.0.2", "10.0.0.2", [200, 429]),
        ("10.0.0.2", "10.0.0.3", [200, 200]),
        ("2001:db8::1", "2001:db8::2:1", [200, 429]),
        ("2001:db8::1", "2001:db8:0:1::1", [200, 200]),
    ],
)
@in_simulated_time
async def test_without_tokens_the_address_is_the_holder(
    first: str, second: str, statuses: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(body_memory, "HOLDER_BODY_BYTES_MAX", 150)
    door = Pending(SMALL)
    given: list[int] = []

    async def ask(address: str) -> None:
        answer = await door.request("POST", WRITE, body=b"x" * 90, client=(address, 50_000))
        given.append(answer.status)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(ask, first)
        tasks.start_soon(ask, second)
        await anyio.sleep(1)
        door.go_on.set()
    assert sorted(given) == statuses


@pytest.mark.parametrize(
    ("method", "path", "most"),
    [
        ("POST", "/api/v1/find", 65_536),
        ("POST", f"{READ}/1/1/fetch", 65_536),
        ("POST", f"{READ}/1/1/restore", 65_536),
        ("PUT", f"{READ}/1/1/params/A", 65_536),
        ("POST", f"{READ}/1/1/metadata", 65_536),
        ("POST", f"{READ}/1/1/diff", 3 << 20),
        ("POST", f"{READ}/1/1/plan", 3 << 20),
        ("POST", f"{READ}/1/1/verify", 3 << 20),
        ("POST", f"{READ}/1/1/apply", 3 << 20),
        ("PATCH", f"{READ}/1/1/params", 3 << 20),
        ("POST", "/api/v1/fleet/diff", 3 << 20),
        ("POST", "/api/v1/files", 2 << 20),
        ("PUT", f"{READ}/1/1/metadata", 8 << 20),
    ],
)
@in_simulated_time
async def test_only_values_and_files_may_be_long(method: str, path: str, most: int) -> None:
    door = Door()
    long = await door.request(method, path, raw=[(b"content-length", b"%d" % (most + 1)), _JSON])
    assert (long.status, long.problem, long.requested) == (413, "too-large", [])
    assert str(most).encode() in long.body
    assert not door.seen
    assert (await door.request(method, path, body=b"x" * most)).status == 200


@pytest.mark.parametrize("method", ["GET", "HEAD", "DELETE", "OPTIONS"])
@in_simulated_time
async def test_only_what_has_a_body_may_bring_one(method: str) -> None:
    for settings, token in ((OPEN, None), (GUARDED, ANNA)):
        answer = await Door(settings).request(method, path="/", body=b"{}", token=token)
        assert answer.problem == "bad-request"
        assert not answer.requested


@in_simulated_time
async def test_those_without_a_token_send_nothing() -> None:
    door = Door(GUARDED)
    answer = await door.request("POST", WRITE, body=[b"x"] * 10)
    assert (answer.problem, answer.requested) == ("unauthenticated", [])
    answer = await door.request("DELETE", SESSION_PATH, body=[b"x"] * 10)
    assert (answer.problem, answer.requested) == ("bad-request", [])


# What every answer has


@pytest.mark.parametrize("path", ["/", "/page/app.js", "/docs", "/health", READ])
@in_simulated_time
async def test_every_answer_has_what_keeps_a_browser_from_running_it(path: str) -> None:
    door = Door(
        headers=[(b"content-security-policy", b"default-src *"), (b"X-Content-Type-Options", b"sniff")]
    )
    for answer in (await door.request(path=path), await door.request(path=path, host="evil.example")):
        headers = answer.headers
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["cross-origin-opener-policy"] == "same-origin"
        assert headers["cross-origin-resource-policy"] == "same-origin"
        policy = headers["content-security-policy"].split("; ")
        assert {
            "default-src 'none'",
            "frame-ancestors 'none'",
            "base-uri 'none'",
            "form-action 'none'",
        } <= set(policy)
        is_page = path in ("/", "/page/app.js", "/docs")
        assert ("script-src 'self'" in policy) == is_page
        assert ("sandbox" in policy) != is_page
        assert headers["cache-control"] == ("no-cache" if is_page else "no-store")
        assert not [name for name in headers if name.startswith("access-control")]


@in_simulated_time
async def test_the_end_of_the_application_is_passed_on() -> None:
    seen = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        seen.append(scope["type"])

    await AccessMiddleware(app, OPEN)({"type": "lifespan"}, None, None)  # type: ignore[arg-type]  # not used
    assert seen == ["lifespan"]


_JSON = (b"content-type", b"application/json")
