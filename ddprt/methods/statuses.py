"""What a fit may say about itself. Trouble is a value: a name in the report, with a paragraph here."""

STATUSES = {
    "no_signal": "Nothing was measured, or no indirect light exists: the result is black. Likely causes: lamps that do not "
    "reach the scene, surfaces that face nothing, albedo 0. What to do: look at the direct lightmaps; move the lamps or the "
    "points, or check that normals point into the room.",
    "diverged": "Training met numbers that are not finite; the weights of the best round before are kept, and training was not "
    "started again. Likely causes: a learning rate too high, or lightings that are bright though hardly any point sees them. "
    "What to do: lower learning_rate of the method in [methods.settings], or use more points.",
    "worse_than_mean": "On the validation lightings this method is worse than the mean lightmap, or hardly better than black. "
    "Likely causes: too few training lightings or steps, or validation lightings unlike the training ones or "
    "in other units. What to do: bake more lightings, train longer, or take another method; do not ship it.",
    "overfitted": "A training lighting that is left out is predicted no better than by black (where centred, by the mean): "
    "what was learned does not carry over. Likely causes: a ridge given too small, fewer lightings than points, lightings "
    'that have nothing in common. What to do: use ridge = "auto", or more lightings.',
    "ill_conditioned": "Some measurements nearly repeat each other and no ridge holds them back, so that rounding is amplified "
    "more than a million times. Likely causes: points that see the same light, together with a ridge given as 0 or chosen "
    'near it. What to do: use ridge = "auto", a ridge of 1e-8 or more, or points further apart.',
    "extrapolating": "Some validation or held-out lightings lie outside of what the training lightings span, and there the "
    "result is a guess. Likely causes: lamps of another kind or in another region than in training. What to do: train on "
    "lightings like those that will be asked for, or fade to the mean where trust is low.",
    "blind": "Some lightings bring indirect light but no measurement point sees them: their result is black, which alone costs "
    "more than 1 % of error. Likely causes: too few points, or lamps in niches and behind objects. What to do: raise "
    "points.count, or keep lamps where points can see them.",
    "overdamped": "The ridge takes more than half even of the strongest direction, so the result is far too dark (with "
    "centring, near the mean). Likely causes: a ridge given too large, or measurements that tell nothing about the indirect "
    'light. What to do: use ridge = "auto"; if that chose it, use other points or more lightings.',
    "rank_deficient": "The data has fewer independent directions than were asked for, so that fewer bases (or measurements) "
    "are in use. Likely causes: few or similar lightings, points that see the same light. What to do: bake more varied "
    "lightings, or ask for fewer bases.",
    "few_lightings": "Two distinct lightings or fewer are left, twins counted once: leaving one out compares nothing, so the "
    "ridge is arbitrary. Likely causes: a small training split, or lightings that differ in brightness alone. What to do: "
    "bake more lightings with other lamp positions.",
    "dominated": "One lighting makes more than half of the leave-one-out error, so that it alone would decide the ridge; "
    "the geometric mean over lightings decided instead. Likely causes: one lamp far brighter than all others, or a few "
    "millimetres from a surface. What to do: compare the median with "
    "the pooled error; raise the lightings' clearance, or bake more lightings like it.",
    "ridge_at_end": "The lowest leave-one-out error lies at an end of the path: at ridge 0, where more ridge only hurts, or "
    "at ten times the largest squared singular value, where hardly anything is learned. Likely causes: data without noise, or "
    "measurements that tell nothing. What to do: at 0 nothing, if conditions are low; at the other end use other points.",
    "choices_disagree": "Generalised cross-validation prefers a ridge whose leave-one-out error is more than a tenth above the "
    "lowest. Likely causes: lightings of very unequal influence, or fewer lightings than points. What to do: look at both "
    "curves and at the held-out error; bake more lightings.",
    "ok": "All is as it should be. Likely causes: enough lightings, and points that see them. What to do: nothing.",
}
"""A paragraph per status: what happened, likely causes, what to do. The worst stands first: where several hold, it leads."""

NOTES = frozenset({"few_lightings", "dominated", "ridge_at_end", "choices_disagree"})
"""Statuses about how the ridge was chosen rather than about the result: they are kept as remarks and leave "ok" alone."""

BLIND = 1e-4
"""Share of the indirect energy that may come from lightings no point sees: answering them with black costs 1 % of error."""


def worst_first(names: set[str]) -> tuple[str, ...]:
    """The statuses in the order of `STATUSES`, "ok" left out; a name that is not listed leads, so that it is not lost."""
    order = {name: place for place, name in enumerate(STATUSES)}
    return tuple(sorted(names - {"ok"}, key=lambda name: (order.get(name, -1), name)))
