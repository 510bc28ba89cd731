"""Power flow: what every topology action would do to one snapshot of a grid."""
