"""World models and evolutions in turn (Ha & Schmidhuber 2018, section 5), as one resumable verb.

Pure: `config`, `plan`, `ledger`, `layout`, `commands`, `gate`, `summary`. `artefacts` reads and removes files,
`process` runs a verb, `evolving` a run with its workers, `phases` does one, `iteration` goes from one to the next.
"""
