"""What accuracy costs: settings tried, timed, scored on one held-out truth and compared.

Enters: configurations, datasets, models. Leaves: records of measured settings, budgets of error, chosen settings, pages.
Never enters: another way to bake, fit or score than the rest of the walk has.
"""
