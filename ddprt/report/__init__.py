"""What came out: errors on held-out lightings, figures, one page.

Enters: a dataset, models, the stages of a run. Leaves: metrics.json and report.html. Nothing here changes a model.
"""
