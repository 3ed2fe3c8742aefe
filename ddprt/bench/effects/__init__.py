"""What each effect is worth: `ddprt bench --effects`.

Enters: a configuration, whose scene and held-out lightings are baked with each effect and without it. Leaves: what that changed
in light, seconds and rays.
Never enters: another way to bake than the plan's own, with an effect forced off.
"""
