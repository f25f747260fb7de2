"""`python -m toy ARGUMENTS` is `wbm ARGUMENTS` with the toy stages."""

from stages.cli import main
from toy.register import install

install()
main()
