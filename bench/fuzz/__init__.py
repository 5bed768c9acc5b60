"""Bad input for everything that is public: what the library promises for it, tried at random and by the million.

`python -m bench.fuzz` tries all targets, `python -m bench.fuzz.calls` the functions, `python -m bench.fuzz.files` the readers
of files; `--workers 16 --seconds 420 --out FILE` on a large machine, `--only NAME --seed N` to see one failure again.
"""
