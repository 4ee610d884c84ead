-- ================================================================================================
-- rosbayes: bm1
-- A board: a BM1 with its registers and an AXI4-Lite slave, configured by bm1_parameters.vhd.
-- MIT licence; datasheet: docs/hardware/bm1.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

library work;
  use work.bm1_parameters.all;
  use work.bm1_utilities.all;
  use work.bm_register_map.all;

entity bm1 is
  generic (
    BOARD         : natural  := 0;                      -- index of this board in the constant PARTITIONS
    MEMORY_FOLDER : string   := "bm_arch/Memory_MIFs/"; -- folder of the MIFs, with a trailing slash
    CLOCK_HZ      : positive := 100_000_000             -- frequency of the clock
  );
  port (
    -- system
    clk_i  : in    std_logic; -- clock
    rstn_i : in    std_logic; -- reset of the board, active low, synchronous
    irq_o  : out   std_logic; -- pulse: the machine has stopped
    -- AXI4-Lite
    axi_awvalid : in    std_logic; -- write address channel
    axi_awready : out   std_logic;
    axi_awaddr  : in    std_logic_vector(BAR_ADDRESS_BITS - 1 downto 0);
    axi_awprot  : in    std_logic_vector(2 downto 0);
    axi_wvalid  : in    std_logic; -- write data channel
    axi_wready  : out   std_logic;
    axi_wdata   : in    std_logic_vector(31 downto 0);
    axi_wstrb   : in    std_logic_vector(3 downto 0);
    axi_bvalid  : out   std_logic; -- write response channel
    axi_bready  : in    std_logic;
    axi_bresp   : out   std_logic_vector(1 downto 0);
    axi_arvalid : in    std_logic; -- read address channel
    axi_arready : out   std_logic;
    axi_araddr  : in    std_logic_vector(BAR_ADDRESS_BITS - 1 downto 0);
    axi_arprot  : in    std_logic_vector(2 downto 0);
    axi_rvalid  : out   std_logic; -- read data channel
    axi_rready  : in    std_logic;
    axi_rdata   : out   std_logic_vector(31 downto 0);
    axi_rresp   : out   std_logic_vector(1 downto 0)
  );
end entity bm1;

architecture rtl of bm1 is

  constant BOARD_LINES : positive := PARTITIONS(BOARD).lines;
  constant INPUTS      : natural  := REPLICAS * SENSORS * inputs_per_column(SENSOR_MODE, BOARD_LINES);

  signal rst             : std_logic;
  signal request         : std_logic;
  signal write           : std_logic;
  signal address         : std_logic_vector(BAR_ADDRESS_BITS - 1 downto 0);
  signal strobe          : std_logic_vector(3 downto 0);
  signal write_data      : std_logic_vector(31 downto 0);
  signal respond         : std_logic;
  signal refused         : std_logic;
  signal read_data       : std_logic_vector(31 downto 0);
  signal start           : std_logic;
  signal resume          : std_logic;
  signal reset           : std_logic;
  signal target          : std_logic_vector(COUNTER_BITS - 1 downto 0);
  signal most_cycles     : std_logic_vector(63 downto 0);
  signal run_until       : std_logic_vector(63 downto 0);
  signal bank            : std_logic_vector(bits_for(RNG_BANKS) - 1 downto 0);
  signal halt            : std_logic_vector(REPLICAS - 1 downto 0);
  signal priors          : std_logic_vector(REPLICAS * SLOT_BITS - 1 downto 0);
  signal prior_codes     : std_logic_vector(REPLICAS * BOARD_LINES * SLOT_BITS - 1 downto 0);
  signal readings        : std_logic_vector(INPUTS * SLOT_BITS - 1 downto 0);
  signal running         : std_logic;
  signal done            : std_logic;
  signal has_run         : std_logic;
  signal cycles          : std_logic_vector(63 downto 0);
  signal reason          : std_logic_vector(2 downto 0);
  signal ready           : std_logic_vector(REPLICAS - 1 downto 0);
  signal replica_reasons : std_logic_vector(3 * REPLICAS - 1 downto 0);
  signal replica_cycles  : std_logic_vector(64 * REPLICAS - 1 downto 0);
  signal counts          : std_logic_vector(REPLICAS * BOARD_LINES * COUNTER_BITS - 1 downto 0);

begin

  assert MAP_HASH = MAP_SHA256
    report "bm1_parameters.vhd was written for another register map than bm_register_map.vhd: build the deployment again"
    severity failure;

  assert RNG_KIND /= RNG_IDEAL
    report "rng = ideal exists emulated only: build the deployment with an LFSR or a table"
    severity failure;

  rst <= not rstn_i;

  axi : entity work.bm1_axi
    generic map (
      address_bits => BAR_ADDRESS_BITS
    )
    port map (
      clk_i       => clk_i,
      rst_i       => rst,
      axi_awvalid => axi_awvalid,
      axi_awready => axi_awready,
      axi_awaddr  => axi_awaddr,
      axi_wvalid  => axi_wvalid,
      axi_wready  => axi_wready,
      axi_wdata   => axi_wdata,
      axi_wstrb   => axi_wstrb,
      axi_bvalid  => axi_bvalid,
      axi_bready  => axi_bready,
      axi_bresp   => axi_bresp,
      axi_arvalid => axi_arvalid,
      axi_arready => axi_arready,
      axi_araddr  => axi_araddr,
      axi_rvalid  => axi_rvalid,
      axi_rready  => axi_rready,
      axi_rdata   => axi_rdata,
      axi_rresp   => axi_rresp,
      request_o   => request,
      write_o     => write,
      address_o   => address,
      strobe_o    => strobe,
      data_o      => write_data,
      respond_i   => respond,
      refused_i   => refused,
      data_i      => read_data
    );

  registers : entity work.bm1_registers
    generic map (
      lines             => BOARD_LINES,
      sensors           => SENSORS,
      replicas          => REPLICAS,
      mode              => SENSOR_MODE,
      address_bits      => SENSOR_BITS,
      prob_bits         => PROB_BITS,
      prior_bits        => PRIOR_BITS,
      written           => PRIOR_WRITTEN,
      counter_bits      => COUNTER_BITS,
      kind              => RNG_KIND,
      rng_shared        => RNG_SHARED,
      steps             => STEPS_PER_CLOCK,
      banks             => RNG_BANKS,
      reset_bank        => RNG_RESET_BANK,
      interface_inputs  => INTERFACE_SENSORS,
      interface_results => INTERFACE_RESULTS,
      model_lines       => LINES,
      line_offset       => PARTITIONS(BOARD).line_offset,
      board             => BOARD,
      boards            => BOARDS,
      image_hash        => PARTITIONS(BOARD).image_hash,
      memory_folder     => MEMORY_FOLDER,
      clock_hz          => CLOCK_HZ
    )
    port map (
      clk_i             => clk_i,
      rst_i             => rst,
      irq_o             => irq_o,
      request_i         => request,
      write_i           => write,
      address_i         => address,
      strobe_i          => strobe,
      data_i            => write_data,
      respond_o         => respond,
      refused_o         => refused,
      data_o            => read_data,
      start_o           => start,
      resume_o          => resume,
      reset_o           => reset,
      target_o          => target,
      max_cycles_o      => most_cycles,
      run_until_o       => run_until,
      bank_o            => bank,
      halt_o            => halt,
      priors_o          => priors,
      prior_codes_o     => prior_codes,
      inputs_o          => readings,
      running_i         => running,
      done_i            => done,
      has_run_i         => has_run,
      cycles_i          => cycles,
      reason_i          => reason,
      ready_i           => ready,
      replica_reasons_i => replica_reasons,
      replica_cycles_i  => replica_cycles,
      counts_i          => counts
    );

  core : entity work.bm1_core
    generic map (
      lines         => BOARD_LINES,
      sensors       => SENSORS,
      replicas      => REPLICAS,
      mode          => SENSOR_MODE,
      address_bits  => SENSOR_BITS,
      prob_bits     => PROB_BITS,
      prior_bits    => PRIOR_BITS,
      written       => PRIOR_WRITTEN,
      counter_bits  => COUNTER_BITS,
      kind          => RNG_KIND,
      state_bits    => SEED_BITS,
      taps          => RNG_TAPS,
      rng_shared    => RNG_SHARED,
      steps         => STEPS_PER_CLOCK,
      banks         => RNG_BANKS,
      reset_bank    => RNG_RESET_BANK,
      table_length  => RNG_TABLE_LENGTH,
      memory_folder => MEMORY_FOLDER,
      board         => BOARD
    )
    port map (
      clk_i             => clk_i,
      rst_i             => rst,
      start_i           => start,
      resume_i          => resume,
      reset_i           => reset,
      target_i          => target,
      max_cycles_i      => most_cycles,
      run_until_i       => run_until,
      bank_i            => bank,
      halt_i            => halt,
      priors_i          => priors,
      prior_codes_i     => prior_codes,
      inputs_i          => readings,
      running_o         => running,
      done_o            => done,
      has_run_o         => has_run,
      cycles_o          => cycles,
      reason_o          => reason,
      ready_o           => ready,
      replica_reasons_o => replica_reasons,
      replica_cycles_o  => replica_cycles,
      counts_o          => counts
    );

end architecture rtl;
