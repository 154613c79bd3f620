"""Which requests are sent again."""

import threading
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime

import httpx
import pytest

from sightfix import Client, ConnectionFailedError, Observation, RetryPolicy, UnavailableError
from tests.conftest import ServerProcess

QUICK = RetryPolicy(attempts=3, initial_delay_s=0.001, max_delay_s=0.01)
OBSERVATION = Observation(time=datetime(2026, 1, 1, tzinfo=UTC))


def problem(kind: str) -> httpx.Response:
    body = {
        "type": f"urn:sightfix:problem:{kind}",
        "title": kind,
        "status": 503,
        "detail": "",
        "trace_id": "1",
    }
    headers = {"content-type": "application/problem+json", "retry-after": "1"}
    return httpx.Response(503, json=body, headers=headers)


class Faults(httpx.BaseTransport):
    """Answers with the given faults in turn, then with an empty list of fusions."""

    def __init__(self, *faults: httpx.Response | Exception) -> None:
        self.faults = list(faults)
        self.requests = 0

    def handle_request(self, request: httpx.Request) -> httpx.Response:  # noqa: D102, as its base class
        self.requests += 1
        if not self.faults:
            return httpx.Response(200, json={"items": []})
        fault = self.faults.pop(0)
        if isinstance(fault, Exception):
            raise fault
        return fault


@pytest.mark.parametrize(
    ("fault", "idempotent", "others"),
    [
        (problem("overloaded"), True, True),
        (problem("shutting-down"), True, False),
        (httpx.ConnectError("refused"), True, True),
        (httpx.ReadError("reset"), True, False),
        (httpx.RemoteProtocolError("closed"), True, False),
        (httpx.ReadTimeout("silent"), True, False),
    ],
)
def test_a_request_is_sent_again_where_that_is_safe(
    fault: httpx.Response | Exception, *, idempotent: bool, others: bool
) -> None:
    for method, is_repeated in (("fuse", idempotent), ("follow", others)):
        faults = Faults(fault)
        with Client(transport=faults, retry=QUICK) as client:
            try:
                if method == "fuse":
                    client.fusions.fuse_batch("yard", [OBSERVATION])
                else:
                    client.tracks.follow("yard", [OBSERVATION])
            except (UnavailableError, ConnectionFailedError):
                assert not is_repeated
        assert faults.requests == (2 if is_repeated else 1), method


def test_attempts_end() -> None:
    faults = Faults(*[problem("overloaded")] * 9)
    with pytest.raises(UnavailableError), Client(transport=faults, retry=QUICK) as client:
        client.server()
    assert faults.requests == 3


def test_delays_grow_and_follow_the_server() -> None:
    policy = RetryPolicy(initial_delay_s=0.2, max_delay_s=5.0, draw=lambda: 1.0)
    assert [policy.delay_s(failures) for failures in (1, 2, 3, 9)] == [0.2, 0.4, 0.8, 5.0]
    assert policy.delay_s(1, 3.0) == 3.0
    assert policy.delay_s(1, 3600.0) == 5.0
    assert RetryPolicy(draw=lambda: 0.0).delay_s(1) == 0.1


def test_a_date_to_retry_after_is_understood() -> None:
    from sightfix._request import retry_after_s  # noqa: PLC0415

    now = datetime(2026, 1, 1, tzinfo=UTC)
    for header, seconds in [
        (format_datetime(now + timedelta(seconds=7), usegmt=True), 7.0),
        (format_datetime(now - timedelta(seconds=7), usegmt=True), 0.0),
        ("2", 2.0),
        ("soon", None),
    ]:
        assert retry_after_s(httpx.Response(503, headers={"retry-after": header}), now) == seconds


def test_what_is_no_problem_document_is_still_an_error() -> None:
    page = httpx.Response(502, text="<html>Bad gateway</html>", headers={"content-type": "text/html"})
    with (
        pytest.raises(UnavailableError, match="502"),
        Client(transport=Faults(page, page, page), retry=QUICK) as client,
    ):
        client.server()


def test_a_restart_of_the_server_is_not_noticed(server: ServerProcess) -> None:
    with Client(server.url) as client:
        version = client.server().version
        server.kill()
        restart = threading.Timer(0.3, server.start)
        restart.start()
        assert client.server().version == version
        restart.join()
