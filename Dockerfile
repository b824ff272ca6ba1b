# Two stages: the first one has a compiler and builds a wheel, the second one installs the wheel without a compiler.
#   docker build -t sigmasplat .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" sigmasplat run kitchen
ARG PYTHON=3.11

FROM python:${PYTHON}-slim AS build
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
WORKDIR /build
COPY pyproject.toml CMakeLists.txt constraints.txt LICENSE README.md ./
COPY src src
# pip before 25.3 takes the constraints of build tools from the first variable, later versions from the second.
RUN PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt \
    pip wheel --no-cache-dir --no-deps --wheel-dir wheels .

FROM python:${PYTHON}-slim
# EXTRAS=viewer,ros adds extras. TORCH_INDEX is the index for torch; the default has no CUDA libraries.
ARG EXTRAS=""
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
COPY constraints.txt /tmp/sigmasplat/
COPY --from=build /build/wheels /tmp/sigmasplat/
RUN wheel=$(ls /tmp/sigmasplat/*.whl) && \
    pip install --no-cache-dir -c /tmp/sigmasplat/constraints.txt --extra-index-url "$TORCH_INDEX" \
    "$wheel${EXTRAS:+[$EXTRAS]}"
RUN useradd --create-home sigmasplat && install --directory --owner sigmasplat /data
USER sigmasplat
RUN sigmasplat doctor
WORKDIR /data
ENTRYPOINT ["sigmasplat"]
CMD ["--help"]
