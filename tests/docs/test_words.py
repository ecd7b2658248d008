"""Documents are short and plain: README's length, sentences over thirty words, words that are read twice."""

import pytest

from deploy.words import PRINTED, banned_in, long_sentences, measure, sentences, sizes, words
from tests.support.processes import ROOT

README_WORDS = 900  # code blocks included
LARGEST = {"user": 45_000, "lab": 20_000}
# What still stands in pages and printed texts. These numbers may only shrink.
ALLOWED = {"long": 4, "banned": 3, PRINTED: 0}
CLEAN = ("README.md", "CONTRIBUTING.md", "docs/index.md", "docs/tutorials/")


@pytest.fixture(scope="module")
def figures():
    return measure()


def test_documents_keep_to_their_size():
    assert len((ROOT / "README.md").read_text().split()) <= README_WORDS, "it is read in five minutes"
    found = sizes()
    assert found.keys() == LARGEST.keys()
    assert {kind: count for kind, count in found.items() if count > LARGEST[kind]} == {}, "`make words` lists the pages"


def test_pages_that_are_read_first_have_no_long_sentence_and_no_banned_word(figures):
    pages = [page for page in figures if page.startswith(CLEAN)]
    assert {page: long_sentences(page) for page in pages if long_sentences(page)} == {}, "`make words PAGES=PAGE`"
    assert {page: banned_in(page) for page in pages if banned_in(page)} == {}, "deploy/banned-words.txt has better ones"


def test_the_others_get_no_worse(figures):
    pages = [figure for name, figure in figures.items() if name != PRINTED]
    found = {"long": sum(each["long"] for each in pages), "banned": sum(each["banned"] for each in pages)}
    found[PRINTED] = figures[PRINTED]["banned"]
    assert {name: count for name, count in found.items() if count > ALLOWED[name]} == {}, "`make words` lists the pages"


def test_sentences_are_cut_where_a_reader_stops():
    page = "# A head\n\nOne sentence, e.g. this. Another `--flag x.y` here! (A third.)\nIts end.\n\n- An item\n"
    found = list(
        sentences(f"{page}  of two lines. `code` begins this one\n\n| a cell. Two | *b* |\n\n```sh\nno sentence\n```\n")
    )
    assert "|".join(found) == (
        "A head|One sentence, e.g. this.|Another CODE here!|(A third.)|Its end.|An item of two lines."
        "|CODE begins this one|a cell.|Two|*b*"
    )
    assert [len(words(each)) for each in found[:3]] == [2, 4, 3]
