"""Suites of `nesy bench`, in the order in which it measures them: one module each, named like the suite.

A suite is a module with a docstring (its first line says what is measured), `NEEDS` (the steps that the run folder
must hold, of `nesy.run_folder.STEPS`; empty where no run is needed) and `measure(settings) -> list[Row]`, where
`settings` is a `measuring.Settings`. To add one, write the module and name it here.
"""

SUITES: tuple[str, ...] = ("env", "model", "dbn", "planner", "dqn", "asp")
