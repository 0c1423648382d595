# stereophd with its kernels compiled: `docker run --rm -v "$PWD":/data stereophd track ...` answers in seconds.
#   docker build -t stereophd .
FROM python:3.12-slim AS wheel
WORKDIR /source
COPY . .
RUN pip wheel --no-deps --wheel-dir /wheels .

FROM python:3.12-slim
COPY constraints.txt /tmp/constraints.txt
COPY --from=wheel /wheels /wheels
RUN pip install --no-cache-dir -c /tmp/constraints.txt "$(ls /wheels/*.whl)[plot,report]" \
    && rm -r /wheels /tmp/constraints.txt
# Kernels for any x86 processor since 2013, in a layer of their own that every user of the container can read.
ENV NUMBA_CACHE_DIR=/opt/kernels STEREOPHD_TARGET=portable
RUN stereophd compile --jobs 2 && chmod -R a+rX /opt/kernels
WORKDIR /data
ENTRYPOINT ["stereophd"]
CMD ["--help"]
