"""An asset under a sun: how much light leaks behind it by classical PRT, and by ours with as many numbers?

Question: light told by harmonics is blurred before it meets the asset, so that a sun reaches behind it (the paper's section 6.4
          and Figure 12). How much, at which order, and what does svd-ridge do with (order + 1)² bases?
Command:  python experiments/asset_sh.py [seed ...]   (docs/asset-sh.png; seconds with --quick, which draws nothing)
Answer:   docs/paper.md, "Classical PRT"

A texel is behind the asset where direct and indirect light together are below 1 % of the brightest direct light of its lighting,
in luminance. Leak is the light that a method puts there, over all light that it gives (absolute values before the clamp at 0 are
told apart by the clamp: both are clamped). The reference has a leak too, of what it holds below that line.
"""
