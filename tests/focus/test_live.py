"""Who may look at a loop, and what is seen. Truth: requests by the standard library, and a browser."""

import json
import math
import shutil
import socket
import subprocess
import time
from contextlib import contextmanager
from dataclasses import replace
from http.client import HTTPConnection
from urllib.parse import urlsplit

import pytest
from helpers import focus_loop as made

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.focus.journal import Journal, event_line
from irlos_pipe.focus.live import LivePage, PageSettings, Publisher

TOKEN = "a-token-of-some-length"


@contextmanager
def served(token: str = ""):
    page = LivePage(PageSettings(0, "127.0.0.1", token))
    yield page
    page.close()


@pytest.fixture
def page():
    with served() as page:
        for record in made.records(5):
            page.show(record.line())
        yield page


def answer(page: LivePage, path: str, **headers: str) -> tuple[int, bytes]:
    connection = HTTPConnection(urlsplit(page.url).netloc)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    return response.status, response.read()


def lines(page: LivePage, query: str = "") -> dict:
    status, content = answer(page, f"/lines?{query}")
    assert status == 200
    return json.loads(content)


def test_it_serves_the_page_and_the_lines_after_a_number(page):
    assert b"Focus loop" in answer(page, "/")[1]
    page.show(event_line(5, time.time(), "the star is gone"))
    everything = lines(page)
    name = everything["loop"]
    assert [one.get("sequence", one.get("event")) for one in everything["lines"]] == [
        *range(1, 6),
        "the star is gone",
    ]
    assert [one.get("sequence") for one in lines(page, f"after=3&loop={name}")["lines"]] == [4, 5, None]
    assert lines(page, f"after={everything['last']}&loop={name}")["lines"] == []
    for rubbish in ("after=rubbish", "after=%C2%B2", f"after={'9' * 6000}"):
        assert len(lines(page, f"{rubbish}&loop={name}")["lines"]) == 6
    assert answer(page, "/etc/passwd")[0] == 404


def test_after_a_restart_the_page_has_the_hour_from_the_record(tmp_path):
    journal = Journal(tmp_path)
    old, *young = made.records(4)
    journal.add(replace(old, recorded_unix_s=time.time() - 4000.0))
    journal.event("frames come again")
    for record in young:
        journal.add(record)
    journal.close()
    again = Journal(tmp_path)
    found = [json.loads(line) for _, line in again.recent(time.time() - 3600.0)]
    again.close()
    assert [one.get("event", one.get("sequence")) for one in found] == ["frames come again", 2, 3, 4]


def test_it_listens_on_the_loopback_and_answers_no_other_name(page):
    assert urlsplit(page.url).hostname == "127.0.0.1"
    assert answer(page, "/", Host="example.org")[0] == 403
    assert answer(page, "/", Host="localhost")[0] == 200


@pytest.mark.parametrize(
    ("address", "token", "words"),
    [
        ("0.0.0.0", "", "token of at least 16"),
        ("example.org", "", "IP address"),
    ],
)
def test_no_address_beyond_the_loopback_without_a_token_and_no_name(address, token, words):
    with pytest.raises(ConfigurationError, match=words):
        PageSettings(0, address, token)


def test_with_a_token_only_who_has_it_is_answered():
    with served(TOKEN) as page:
        assert answer(page, "/")[0] == answer(page, "/lines?after=0&token=wrong")[0] == 403
        assert lines(page, f"token={TOKEN}")["lines"] == []


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="no browser")
def test_a_browser_draws_it(page):
    page.show(event_line(5, time.time(), "the star is gone"))
    lost = replace(made.records(1)[0], sequence=6, flux_e=math.nan, defocus_nm=math.nan, valid=False)
    page.show(lost.line())
    command = [
        "chromium",
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=10000",
        "--dump-dom",
    ]
    text = subprocess.run([*command, page.url], capture_output=True, text=True, timeout=120).stdout
    assert "tracking" in text
    assert text.count("<circle") == 4 * 6 - 1
    assert "exposures 1 to 6" in text
    assert "the star is gone" in text
    assert "<dt>star</dt><dd>–</dd>" in text  # as it was not seen


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
    Publisher(tmp_path / "s")  # of a loop that was killed: nobody listens
    Publisher(tmp_path / "s").close()
    (tmp_path / "file").write_text("text")
    for name, words in (("file", "another file"), ("long" * 40, "too long")):
        with pytest.raises(ConfigurationError, match=words):
            Publisher(tmp_path / name)


# -- visitors who mean no good -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "request_line",
    [b"GET http://[::bad/ HTTP/1.0\r\n", b"GET / HTTP/1.0\r\nHost: [\r\n"],
    ids=["address", "host"],
)
def test_what_is_no_address_is_a_bad_request_without_a_word(page, capfd, request_line):
    with socket.create_connection(("127.0.0.1", urlsplit(page.url).port), timeout=5) as client:
        client.sendall(request_line + b"\r\n")
        assert client.recv(1000).split()[1] == b"400"
    assert capfd.readouterr().err == ""


def test_the_socket_of_a_living_loop_is_not_taken_away(tmp_path):
    first = Publisher(tmp_path / "s")
    with pytest.raises(ConfigurationError, match="another loop listens there"):
        Publisher(tmp_path / "s")
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "s"))
        first.send("one\n")
        assert client.recv(10) == b"one\n"
    first.close()
