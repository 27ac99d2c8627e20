"""Results of finite element programs: readers of VTU, XDMF and CSV."""
