"""The paper's figures and statements, recomputed.

accuracy, timing, joint     one command for each of its sections 5, 4 and 6: numbers and figures
*_findings                  the statements, and what those numbers say about them
report                      the command that writes report.md from the numbers, without a new run
finding                     what a statement and a finding consist of
stamps, sersic, joint_bins  galaxies rendered by every method, fitted starts, means by magnitude
figures                     every figure

Imports bench.harness and clresample.
"""
