"""The extended Kalman filter of a model as compiled code: tracing, discretisation, code generation, the
instants of a run.

Nothing here knows a temperature, a file or an estimate; llvmlite is imported in `jit` alone.
"""
