"""CUDA graphs: on a GPU, small networks are held up by the host, which launches their kernels one by one."""
