from numpy import ufunc

betaincinv: ufunc
chdtrc: ufunc
chdtri: ufunc
gammaincinv: ufunc
ndtr: ufunc
ndtri: ufunc
stdtrit: ufunc
