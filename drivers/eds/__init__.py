"""Electronic data sheets (CiA 306) of the bench's devices and of jtqd itself."""
