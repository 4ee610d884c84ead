-- ================================================================================================
-- rosbayes: bm1_generators
-- All random number generators of a board, and the chain that loads a bank of seeds into them.
-- MIT licence; datasheet: docs/hardware/bm1_generators.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library work;
  use work.bm1_parameters.all;
  use work.bm1_utilities.all;

entity bm1_generators is
  generic (
    GENERATORS   : positive;         -- number of generators: one per column or per cell
    KIND         : rng_kind_t;       -- LFSR or table
    STATE_BITS   : positive;         -- width of a generator's state
    TAPS         : std_logic_vector; -- feedback taps of an LFSR; STATE_BITS wide
    STEPS        : positive;         -- steps of a generator per clock
    BANKS        : positive;         -- number of seed sets
    PROB_BITS    : positive;         -- width of a random number
    SEED_FILE    : string;           -- MIF of the seeds, ordered by bank, and within a bank by generator
    TABLE_FILE   : string;           -- MIF of the random numbers, if a table is used
    TABLE_LENGTH : positive          -- number of random numbers in the table
  );
  port (
    clk_i     : in    std_logic;                                             -- clock
    rst_i     : in    std_logic;                                             -- load the seeds of bank 0
    restart_i : in    std_logic;                                             -- load the seeds of bank bank_i
    bank_i    : in    std_logic_vector(bits_for(BANKS) - 1 downto 0);        -- index of the bank
    step_i    : in    std_logic;                                             -- the machine runs a cycle
    ready_o   : out   std_logic;                                             -- all generators have their seeds
    randoms_o : out   std_logic_vector(GENERATORS * PROB_BITS - 1 downto 0); -- random numbers; generator 0 in the lowest bits
    states_o  : out   std_logic_vector(GENERATORS * STATE_BITS - 1 downto 0) -- states; generator 0 in the lowest bits
  );
end entity bm1_generators;

architecture rtl of bm1_generators is

  constant SEEDS        : positive := BANKS * GENERATORS;
  constant ADDRESS_BITS : positive := bits_for(SEEDS);
  constant INDEX_BITS   : positive := bits_for(GENERATORS + 1);

  -- seeds(0) is the output of the memory, seeds(g + 1) the state of generator g
  signal chain     : std_logic_vector((GENERATORS + 1) * STATE_BITS - 1 downto 0);
  signal address   : unsigned(ADDRESS_BITS - 1 downto 0) := (others => '0');
  signal remaining : unsigned(INDEX_BITS - 1 downto 0)   := (others => '0');
  signal reading   : std_logic;
  signal shift     : std_logic                           := '0';
  signal ready     : std_logic                           := '0';

begin

  -- Seeds enter at generator 0 and are shifted on, so the seed of the last generator is read first.
  load_seeds : process (clk_i) is

    variable bank : natural range 0 to 2 ** bits_for(BANKS) - 1;

  begin

    if rising_edge(clk_i) then
      shift <= reading;
      if (rst_i = '1' or restart_i = '1') then
        bank := 0;
        if (rst_i = '0') then
          bank := to_integer(unsigned(bank_i));
        end if;
        address   <= to_unsigned((bank mod BANKS) * GENERATORS + GENERATORS - 1, ADDRESS_BITS);
        remaining <= to_unsigned(GENERATORS, INDEX_BITS);
        shift     <= '0';
        ready     <= '0';
      elsif (reading = '1') then
        remaining <= remaining - 1;
        -- the last address may be 0: do not decrement it below 0
        if (remaining /= 1) then
          address <= address - 1;
        end if;
      else
        ready <= '1';
      end if;
    end if;

  end process load_seeds;

  reading <= '1' when remaining /= 0 else
             '0';
  ready_o <= ready;

  seeds_memory : component bm1_table
    generic map (
      file_name    => SEED_FILE,
      word_bits    => STATE_BITS,
      depth        => SEEDS,
      address_bits => ADDRESS_BITS,
      first_bit    => 0,
      data_bits    => STATE_BITS
    )
    port map (
      clk_i     => clk_i,
      enable_i  => reading,
      address_i => std_logic_vector(address),
      data_o    => chain(STATE_BITS - 1 downto 0)
    );

  each_generator : for g in 0 to GENERATORS - 1 generate

    kind_of_generator : if KIND = RNG_TABLE generate

      generator : entity work.bm1_table_player
        generic map (
          state_bits => STATE_BITS,
          prob_bits  => PROB_BITS,
          table_file => TABLE_FILE,
          length     => TABLE_LENGTH,
          steps      => STEPS
        )
        port map (
          clk_i    => clk_i,
          shift_i  => shift,
          seed_i   => chain((g + 1) * STATE_BITS - 1 downto g * STATE_BITS),
          step_i   => step_i,
          state_o  => chain((g + 2) * STATE_BITS - 1 downto (g + 1) * STATE_BITS),
          random_o => randoms_o((g + 1) * PROB_BITS - 1 downto g * PROB_BITS)
        );

    else generate

      generator : entity work.bm1_lfsr
        generic map (
          state_bits => STATE_BITS,
          taps       => TAPS,
          steps      => STEPS
        )
        port map (
          clk_i   => clk_i,
          shift_i => shift,
          seed_i  => chain((g + 1) * STATE_BITS - 1 downto g * STATE_BITS),
          step_i  => step_i,
          state_o => chain((g + 2) * STATE_BITS - 1 downto (g + 1) * STATE_BITS)
        );

      randoms_o((g + 1) * PROB_BITS - 1 downto g * PROB_BITS) <= chain((g + 1) * STATE_BITS + PROB_BITS - 1 downto (g + 1) * STATE_BITS);
    end generate kind_of_generator;

  end generate each_generator;

  states_o <= chain((GENERATORS + 1) * STATE_BITS - 1 downto STATE_BITS);

end architecture rtl;
