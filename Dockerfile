# One image for every service: the commands, the boat's deployment, and the kernels' machine code.
#   docker compose build
# If RUN steps have no network access, first download the wheels of requirements-image.lock into wheelhouse/
# (docs/how-to/containers.md).
ARG PYTHON_IMAGE=python:3.11-slim-bookworm

FROM ${PYTHON_IMAGE} AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore
RUN python -m venv --without-pip /opt/rosbayes
WORKDIR /build
# a pattern, because COPY fails if a plain name does not exist
COPY requirements-image.lock wheelhous[e] ./wheels/
RUN set -- --require-hashes --no-deps --only-binary :all: -r wheels/requirements-image.lock; \
    if ls wheels/*.whl >/dev/null 2>&1; then set -- --no-index --find-links wheels "$@"; fi; \
    python -m pip --python /opt/rosbayes/bin/python install --quiet "$@"
COPY . .
# setuptools is needed only to install the project
RUN python -m pip --python /opt/rosbayes/bin/python install --quiet --no-deps --no-build-isolation . && \
    python -m pip --python /opt/rosbayes/bin/python uninstall --quiet --yes setuptools && \
    install scripts/with-kernels /opt/rosbayes/bin/
# in a folder without sources, so that the installed packages are compiled
WORKDIR /
ENV PATH=/opt/rosbayes/bin:$PATH
RUN with-kernels --compile && \
    toolchain build /build/casestudies/boat -o /deployment --partitions 4 \
    --uri ws://hub:9090 --topic /boat/sensors --type boat_msgs/Sensors

FROM ${PYTHON_IMAGE}
# a deployment is mounted at its path on the host, which may be below /root
RUN groupadd --gid 10001 rosbayes && \
    useradd --uid 10001 --gid 10001 --no-create-home --home-dir /tmp --shell /usr/sbin/nologin rosbayes && \
    install --directory --owner 10001 --group 10001 --mode 700 /run/rosbayes && \
    chmod 711 /root
COPY --from=build /opt/rosbayes /opt/rosbayes
COPY --from=build /deployment /deployment
ENV PATH=/opt/rosbayes/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 HOME=/tmp BM_DEPLOYMENT=/deployment
WORKDIR /tmp
USER 10001:10001
ENTRYPOINT ["with-kernels"]
CMD ["master", "--help"]
