"""Who may look at a loop, and what is seen. Truth: requests by the standard library, and a browser."""

import json
import shutil
import socket
import subprocess
from http.client import HTTPConnection
from urllib.parse import urlsplit

import pytest
from helpers import focus_loop as made

from irlos_pipe.control.exposures import Accumulator
from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.focus.loop import FocusLoop, LoopSettings
from irlos_pipe.focus.page import LivePage, PageSettings
from irlos_pipe.focus.publisher import Publisher

TOKEN = "a-token-of-some-length"


def records(count: int = 5):
    loop, accumulator = FocusLoop(made.calibration(), LoopSettings()), Accumulator(1)
    return [loop.record(one, 0.0) for i in range(count) for one in accumulator.add(made.read(i, 40.0))]


@pytest.fixture
def page():
    page = LivePage(PageSettings(0))
    for record in records():
        page.show(record.sequence, record.line())
    yield page
    page.close()


def answer(page: LivePage, path: str, **headers: str) -> tuple[int, bytes]:
    connection = HTTPConnection(urlsplit(page.url).netloc)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    return response.status, response.read()


def test_it_serves_the_page_and_the_records_after_a_number(page):
    assert b"Focus loop" in answer(page, "/")[1]
    status, content = answer(page, "/records?after=3")
    assert (status, [one["sequence"] for one in json.loads(content)]) == (200, [4, 5])
    assert len(json.loads(answer(page, "/records?after=rubbish")[1])) == 5
    assert answer(page, "/etc/passwd")[0] == 404


def test_it_listens_on_the_loopback_and_answers_no_other_name(page):
    assert urlsplit(page.url).hostname == "127.0.0.1"
    assert answer(page, "/", Host="example.org")[0] == 403
    assert answer(page, "/", Host="localhost")[0] == 200


@pytest.mark.parametrize(("address", "token"), [("0.0.0.0", ""), ("192.0.2.1", "short"), ("::", "")])
def test_no_address_beyond_the_loopback_without_a_token(address, token):
    with pytest.raises(ConfigurationError, match="token of at least 16"):
        PageSettings(0, address, token)


def test_a_name_is_no_address():
    with pytest.raises(ConfigurationError, match="IP address"):
        PageSettings(0, "example.org")


def test_with_a_token_only_who_has_it_is_answered():
    page = LivePage(PageSettings(0, "127.0.0.1", TOKEN))
    try:
        assert answer(page, "/")[0] == answer(page, "/records?after=0&token=wrong")[0] == 403
        assert answer(page, f"/records?token={TOKEN}") == (200, b"[]")
    finally:
        page.close()


def test_a_port_in_use_is_an_error_in_one_line(page):
    with pytest.raises(ConfigurationError, match=r"cannot listen on 127\.0\.0\.1"):
        LivePage(PageSettings(urlsplit(page.url).port))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="no browser")
def test_a_browser_draws_it(page):
    command = [
        "chromium",
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=3000",
        "--dump-dom",
    ]
    text = subprocess.run([*command, page.url], capture_output=True, text=True, timeout=120).stdout
    assert "tracking" in text
    assert text.count("<circle") == 4 * 5
    assert "exposures 1 to 5" in text


def test_every_client_of_the_socket_gets_each_line(tmp_path):
    publisher = Publisher(tmp_path / "s")
    clients = [socket.socket(socket.AF_UNIX) for _ in range(2)]
    for client in clients:
        client.connect(str(tmp_path / "s"))
    publisher.send("one\n")
    clients[0].close()
    publisher.send("two\n")
    publisher.send("three\n")
    assert clients[1].recv(100) == b"one\ntwo\nthree\n"
    assert (tmp_path / "s").stat().st_mode & 0o077 == 0
    publisher.close()
    assert not (tmp_path / "s").exists()


def test_a_client_that_does_not_read_does_not_stop_the_loop(tmp_path):
    publisher = Publisher(tmp_path / "s")
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "s"))
        for _ in range(2000):
            publisher.send("x" * 1000 + "\n")
    publisher.close()


def test_a_socket_left_behind_is_replaced_and_another_file_is_not(tmp_path):
    Publisher(tmp_path / "s")
    Publisher(tmp_path / "s").close()
    (tmp_path / "file").write_text("text")
    with pytest.raises(ConfigurationError, match="another file"):
        Publisher(tmp_path / "file")
    with pytest.raises(ConfigurationError, match="too long"):
        Publisher(tmp_path / ("long" * 40))
