# docker build -t irlos .
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/work" irlos demo
ARG PYTHON=3.12
FROM python:${PYTHON}-slim
# Another index gives another build of PyTorch: --build-arg TORCH_INDEX=URL, see the Makefile.
ARG TORCH_INDEX=
COPY . /source
RUN if [ -n "$TORCH_INDEX" ]; then \
        python -m pip install --no-cache-dir -c /source/constraints.txt \
            --no-deps --index-url "$TORCH_INDEX" torch; \
    fi \
    && python -m pip install --no-cache-dir -c /source/constraints.txt '/source[paper]' \
    && rm -rf /source \
    && install -d -o 1000 -g 1000 /work
# Any user may run it; what is cached goes where all can write.
ENV HOME=/tmp
USER 1000:1000
WORKDIR /work
ENTRYPOINT ["irlos"]
CMD ["--help"]
