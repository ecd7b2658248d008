"""World models and evolutions in turn (Ha & Schmidhuber 2018, section 5), as one resumable verb.

Pure: `config`, `plan`, `layout`, `requests`, `gate`, `summary`. `ledger` and `artefacts` read and write files, `phases`
does one phase, `runner` goes from one to the next.

Its pages: docs/how-to/rounds.md, docs/reference/files.md.
"""

__all__ = ["runner", "phases", "summary", "ledger", "plan", "config", "layout"]
