"""Many settings, compared: `ddprt bench`.

Enters: a configuration with [sweep], records of settings. Leaves: results.jsonl, fronts of cost and error, a page, figures and
a table. Never enters: models and maps; all that is drawn stands in the records.
"""
