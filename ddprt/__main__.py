"""`python -m ddprt` is `ddprt`."""

from ddprt.cli import main

main()
