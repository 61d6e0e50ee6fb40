"""The language of plant files: real functions of time as text, with exact derivatives.

Numbers, names, ``+ - * / **``, ``t``, ``pi``, ``sin cos tan asin acos atan exp log sqrt sinh cosh
tanh asinh acosh atanh erf abs sign``, ``min`` and ``max`` of two, ``d(.)`` for the time derivative,
and ``step(.)``, which is 0 where its argument is negative and 1 where it is positive. Names may be
those of signals: what depends on them is evaluated along their Taylor coefficients.

Text is read by :func:`parse` into graphs of ``nodes``, recorded on a :class:`Tape` and evaluated
in Taylor arithmetic (``jets``): derivatives of any order, no code generation, nothing executed.
Both sides of a ``step`` are always computed, so ``sqrt(t - 1)*step(t - 1)`` fails for t < 1; an
intermediate value that overflows is refused even where the end result would be finite again, so
``1/(1 + exp(500*t))`` fails for t > 1.4 (``tanh`` does not).
"""
