"""A join file that was edited, or is used while the clock is wrong, is found before it is used."""

import shlex
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from dreamfleet.common.addons.access.authority import Authority
from dreamfleet.common.addons.doctor.health import _check_join_file
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import AccessError
from dreamfleet.common.security.credentials import SEATS, format_join_file, issue_command, read_join_file
from dreamfleet.common.security.handshake import EXPIRED, NOT_YET_VALID, check_certificate
from tests.support.access import Access

ROLES = ("coordinator", "first", "viewer", "operator")


@pytest.fixture(scope="module")
def access(tmp_path_factory):
    return Access(tmp_path_factory.mktemp("keys") / "access")


def test_what_was_issued_is_in_order(access, tmp_path):
    for issued in (access, Access(tmp_path / "access", passwords=True)):
        assert {check_certificate(read_join_file(issued.path(each))) for each in ROLES} == {None}


def test_each_field_that_the_certificate_has_too_must_agree(access, tmp_path):
    other = Access(tmp_path / "access")
    for who in ROLES:
        check_edits(read_join_file(access.path(who)), read_join_file(other.path(who)))


def check_edits(whole, foreign):
    edits = [
        {"seat": whole.seat + 1},
        {"role": "router"},
        {"expires": whole.expires + timedelta(days=1)},
        {"ca": foreign.ca},
        {"key": foreign.key},
        {"ca": ""},
        {"key": ""},
        {"certificate": whole.certificate[:300]},
        {"ca": "gärbage", "certificate": "x"},
    ]
    for edit in edits:
        with pytest.raises(AccessError):
            check_certificate(replace(whole, **edit))
    check_certificate(replace(whole, connect=("tls/elsewhere.example:7447",), name="renamed"))


@pytest.mark.parametrize("verb", ["coordinator", "worker", "status", "router"])
def test_every_verb_refuses_an_edited_file(access, tmp_path, capsys, verb):
    whole = read_join_file(access.path("first" if verb == "worker" else "coordinator"))
    path = tmp_path / "edited.join"
    path.touch(mode=0o600)
    role = "router" if verb == "router" else whole.role
    path.write_text(format_join_file(replace(whole, seat=7, role=role)))
    assert main([verb, "--join", str(path)]) == 1
    assert f"{whole.role}.{whole.seat}" in capsys.readouterr().err
    found = [_check_join_file(each) for each in (path, access.path("first"))]  # by `doctor`
    assert [(each.ok, each.needed) for each in found] == [(False, True), (True, False)]


@pytest.mark.parametrize("role", SEATS)
def test_the_command_that_an_error_names_issues_a_file(tmp_path, role):
    Authority.create(tmp_path / "access")
    words = shlex.split(issue_command(role, "box").replace("FILE", str(tmp_path / "join")))
    assert main([*words[1:], "--access-dir", str(tmp_path / "access")]) == 0
    assert read_join_file(tmp_path / "join").role == role


@pytest.mark.parametrize("days", [-91, 3])
def test_a_wrong_clock_is_called_that(access, tmp_path, days):
    now = datetime.now(UTC) + timedelta(days=days)
    issued = access.authority.issue("viewer", "early", tmp_path / "join", connect=["tls/h.example:1"], now=now)
    with pytest.raises(AccessError) as refused:
        check_certificate(issued)
    assert refused.value.__cause__.verify_code in (NOT_YET_VALID, EXPIRED)
