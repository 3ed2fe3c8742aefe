"""What accuracy costs: settings tried, timed, scored on one held-out truth and compared.

Enters: configurations, datasets, models. Leaves: records of measured settings, budgets of error, chosen settings, pages.
Never enters: another way to bake, fit or score than the rest of the walk has.

`measure` tries, times and scores one setting; `frontier` tries many and draws them; `tune` looks for one within limits;
`effects` leaves out effects of light, one by one; `peers` times other libraries on the same problem; `budget` takes the error
of one model apart. Only `measure` is imported by the others, which know nothing of each other.
"""
