"""World models and evolutions in turn (Ha & Schmidhuber 2018, section 5), as one resumable verb.

Pure: `config`, `plan`, `layout`, `requests`, `gate`, `summary`. `ledger` and `artefacts` read and write files, `phases`
does one phase, `runner` goes from one to the next. Pages: rounds.md, files.md, dreams.md, dreams-notes.md.
"""

__all__ = ["runner", "phases", "summary", "ledger", "plan", "config", "layout"]
